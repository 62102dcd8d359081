"""Many pulses on the emulated network DACs, judged from their own logs: place, energy and caps of each.

A few thousand in every run, a million on all displays with --slow (nightly).
"""

import numpy as np
import pytest

from dac.bench import build_network_display, build_verified
from dac.emulated_ether_dream import VirtualStream
from dac.emulated_idn import VirtualRadio
from dac.judge import judge, judge_caps, read_light
from optodrive.core.clock import ManualClock
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.link.dac.devices.ether_dream import EtherDream
from optodrive.link.dac.devices.idn import Idn
from optodrive.link.dac.encoding import PointScale
from optodrive.link.dac.player import play
from optodrive.planning.stimuli.pattern_registry import build_pattern
from reference_models.shipped_display import build_model, build_worst_factors
from reference_models.thermal_display import build_true_display

ROUNDING_M = 1e-9
NAMES = ("display-1", "display-16", "display-357", "display-437", "display-1511")
EVERY_TIME = ("display-16", "display-437")
DEVICES = {"ether_dream": (VirtualStream, EtherDream), "idn": (VirtualRadio, Idn)}
RATES = (20_000, 33_333, 40_000, 50_000)
SOME, MANY = 600, 100_000
"""Pulses by device and display: in every run, and nightly."""


def play_virtually(transport, display, sequence, **device):
    """Play in virtual time. Return plan, proof and the light of the device's log."""
    link_class, driver = DEVICES[transport]
    clock = ManualClock()
    link = link_class(clock, **device)
    plan, verified = build_verified(display, sequence)
    with driver(display.config.board, clock, link.connect) as dac:
        play(dac, verified, clock)
    link.pass_time(2.0)
    scale = PointScale.from_config(display.config)
    return plan, verified, read_light(link.core.log.table(link.core.now_s), display, scale.point_s)


def draw_sequence(rng, display):
    """Return frames and trains of all kinds: narrow and wide, weak and at full power, close and far apart."""
    count, at_s, frames, trains = len(display.layout), 0.0, [], []
    for number in range(rng.integers(1, 4)):
        heights = np.where(rng.random(count) < min(1.0, 30.0 / count), rng.uniform(1e-6, 40e-6, count), 0.0)
        frames.append(TactileFrame(f"f{number}", at_s, 1.0, heights))
        at_s += 1.0
    for _ in range(rng.integers(1, 5)):
        width_s = float(rng.choice([2e-4, 1e-3, 4e-3, 0.02, 0.05]))
        gap_s = float(rng.choice([2e-4, 2e-3, 0.02]))
        start_s = float(rng.uniform(0.0, at_s))
        trains.append(
            PulseTrain(int(rng.integers(count)), start_s, 0.4, width_s, gap_s, float(rng.uniform(0.05, 2.45)))
        )
    return FrameSequence(tuple(frames), tuple(trains))


def count_judged(transport, name, count, seed=0):
    """Play random sequences until `count` pulses are judged, on devices of all speeds and rates. Return the count."""
    rng = np.random.default_rng(seed)
    true_display = build_true_display(build_model(name), build_worst_factors(name, -1))
    pulses = 0
    while pulses < count:
        trajectories = "early_steps" if transport == "ether_dream" and pulses % 2 else "steps"
        display = build_network_display(transport, name, int(rng.choice(RATES)), trajectories)
        device = {"extra_ticks": int(rng.integers(2))} if transport == "ether_dream" else {}
        if transport == "idn" and rng.random() < 0.5:
            device = {"regulated": False, "speed": float(rng.uniform(1.0, 1.3))}
        plan, verified, light = play_virtually(transport, display, draw_sequence(rng, display), **device)
        emitted_j, overhang_m = judge(light, plan, display)
        assert overhang_m <= ROUNDING_M
        assert emitted_j <= verified.energy_j * (1 + 1e-12)
        assert len(light) == len(verified.pulses)
        if len(light):
            judge_caps(light, display, true_display)
        pulses += len(light)
    return pulses


@pytest.mark.parametrize("transport", DEVICES)
@pytest.mark.parametrize("name", EVERY_TIME)
def test_some_pulses(transport, name):
    assert count_judged(transport, name, SOME) >= SOME


def test_a_pulse_that_a_chunk_cuts_near_its_begin_passes_verification():
    """The mirrors still ring where its first part ends, and a move was counted that they do not make there."""
    assert count_judged("idn", "display-357", SOME, seed=3007) >= SOME


@pytest.mark.slow
@pytest.mark.timeout(0)
@pytest.mark.parametrize("part", range(4))
@pytest.mark.parametrize("transport", DEVICES)
@pytest.mark.parametrize("name", NAMES)
def test_a_million_pulses(transport, name, part):
    """Ten pairs of device and display, four parts of each."""
    assert count_judged(transport, name, MANY // 4, seed=1 + part) >= MANY // 4


@pytest.mark.parametrize(
    ("transport", "trajectories"), [("ether_dream", "steps"), ("ether_dream", "early_steps"), ("idn", "steps")]
)
@pytest.mark.parametrize(("name", "height_m"), [("display-437", 10e-6), ("display-16", 50e-6)])
def test_a_full_frame(transport, trajectories, name, height_m):
    display = build_network_display(transport, name, trajectories=trajectories)
    frame = TactileFrame("full", 0.0, 10.0, np.full(len(display.layout), height_m))
    plan, verified, light = play_virtually(transport, display, FrameSequence((frame,)))
    _, overhang_m = judge(light, plan, display)
    assert overhang_m <= ROUNDING_M
    assert len(light) == len(verified.pulses)


@pytest.mark.parametrize("transport", DEVICES)
@pytest.mark.parametrize("number", [1, *(pytest.param(number, marks=pytest.mark.slow) for number in range(2, 7))])
def test_the_experiments_of_the_paper(transport, number):
    display = build_network_display(transport, "display-437")
    plan, verified, light = play_virtually(
        transport, display, build_pattern(f"experiment-{number}", {}, display.config)
    )
    _, overhang_m = judge(light, plan, display)
    assert overhang_m <= ROUNDING_M
    assert len(light) == len(verified.pulses)


@pytest.mark.parametrize("transport", DEVICES)
def test_gates_that_open_early_are_seen(transport):
    """Mutant: points of a pulse begin a millisecond before the planned time."""
    display = build_network_display(transport, "display-16")
    frame = TactileFrame("full", 0.0, 10.0, np.full(16, 50e-6))
    plan, _, light = play_virtually(transport, display, FrameSequence((frame,)))
    early = type(light)(**(vars(light) | {"start_s": light.start_s - 1e-3}))
    _, overhang_m = judge(early, plan, display)
    assert overhang_m > 1e-5
