"""A real session and each board core over a faulty link in virtual time: 100,000 faults, 400,000 with --slow."""

import random
from dataclasses import replace
from functools import partial
from math import inf

import pytest
from emulated_pico import EmulatedPico, PicoImage
from mutants import MUTANTS
from session_rig import configured
from virtual_rig import VirtualRig, run_fault_sessions
from wire_format import HOST

from optodrive.link.session import arming, board_link
from optodrive.link.session.arming import BITS_PER_BYTE, FRAME_BYTES
from optodrive.link.simulator.guards import DEFAULT_LIMITS

FAULT_RATES = [(1, 0.05), (2, 0.15)]
FAULT_RATES += [
    pytest.param(seed, loss, marks=pytest.mark.slow)
    for seed in (1, 2)
    for loss in (0.01, 0.05, 0.15, 0.3)
    if (seed, loss) not in FAULT_RATES
]
CHIP_FAULTS = 5_000
PICO_FAULTS = 1_000
OFF_LATE_MAX_US = 100
LINE_US = 30_000
"""Time in which all that a host has sent arrives."""
ENDING = tuple(HOST[name][0] for name in ("HELLO", "ABORT"))


@pytest.fixture(params=["python", "c"])
def make_rig(request, virtual):
    """Return a function that builds a rig with a board core."""
    return partial(VirtualRig, make_core=virtual(request.param).make_core)


@pytest.mark.parametrize(("seed", "loss"), FAULT_RATES)
def test_under_link_faults_each_pulse_is_as_sent_once_and_in_order(make_rig, seed, loss):
    rig = make_rig(seed, loss, extra=0.6, pauses=0.001)
    rig.up.never_again = ENDING if seed == 2 else ()
    sessions, pulses = run_fault_sessions(rig)
    kinds = rig.up.counts + rig.down.counts
    print(f"loss {loss:.0%}: {rig.faults} faults, {sessions} sessions, {pulses} pulses; {dict(kinds)}")
    assert pulses > 0
    assert len(kinds) == 11, "a kind of fault that never came"


@pytest.mark.slow
def test_the_emulated_chip_emits_each_pulse_as_sent_once_and_in_order(virtual):
    rig = VirtualRig(6, 0.05, extra=0.6, pauses=0.001, make_core=virtual("qemu").make_core)
    _, pulses = run_fault_sessions(rig, CHIP_FAULTS)
    assert pulses > 0
    rig.core.close()


class OpenPico(EmulatedPico):
    """A Pico whose port stays open, as the link in memory does; its loss is a BREAK behind what is on the line."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.open_port(0)

    def on_link_lost(self, now_us):
        """Send a BREAK and let it arrive."""
        self.send_break(now_us)
        self.advance(now_us + LINE_US)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_emulated_pico_emits_each_pulse_as_sent_once_and_in_order(tmp_path):
    rig = VirtualRig(6, 0.05, extra=0.6, pauses=0.001, make_core=partial(OpenPico, PicoImage(tmp_path)))
    rig.points.make(26)  # whose duty is less than a step of the PWM
    _, pulses = run_fault_sessions(rig, PICO_FAULTS)
    assert pulses > 0
    pins, logged = rig.core.pins, rig.core.nominal_us
    late_us = [at_us - due_us for (at_us, on, _), due_us in zip(pins, logged, strict=True) if not on]
    print(f"{pulses} pulses; gate off at most {max(late_us):.0f} µs late")
    assert min(late_us) >= 0
    assert max(late_us) <= OFF_LATE_MAX_US
    rig.core.close()


BROKEN = {
    "B1": (["b1_gate_stays_on_after_running"], 1),
    "B12": (["b12_duplicates_are_accepted", "b12_index_is_not_checked"], 103),
    "B13": (["b13_no_crc"], 13),
}
"""Mutants of the simulated board, and MUTANT of the C core."""
SEEDS = range(5, 13)
"""Which frames are lost when a seed decides, and not each loss meets the guard."""


@pytest.mark.parametrize("guard", BROKEN)
@pytest.mark.parametrize("core", ["python", "c"])
def test_a_board_that_violates_a_guard_is_detected(monkeypatch, virtual, core, guard):
    names, number = BROKEN[guard]
    for name in names if core == "python" else ():
        monkeypatch.setattr(*MUTANTS[name]())
    make_core = virtual(core, *[number] * (core == "c")).make_core

    def run_all():
        for seed in SEEDS:
            run_fault_sessions(VirtualRig(seed, 0.15, extra=0.6, pauses=0.001, make_core=make_core))

    with pytest.raises(AssertionError):
        run_all()


def test_a_run_can_be_played_again(make_rig, monkeypatch):
    reported = []
    for _ in range(2):
        monkeypatch.setattr(board_link.secrets, "randbits", random.Random(4).getrandbits)
        rig = make_rig(4, 0.1, extra=0.5, pauses=0.002)
        for _ in range(6):
            rig.live(1000, patience_s=4.0)
        reported.append((rig.log, rig.up.log, rig.down.log))
    assert reported[0] == reported[1]
    assert rig.faults > 500


def test_equal_seeds_give_equal_faults():
    one, other = (VirtualRig(3, 0.1, 0.5, 0.01).up for _ in range(2))
    stream = bytes(range(256)) * 40
    assert [one.carry(stream, k) for k in range(9)] == [other.carry(stream, k) for k in range(9)]
    assert one.log == other.log
    assert len(one.log) > 100


# --- what the queue carries -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 6))])
def test_no_underrun_at_five_percent_loss_with_a_queue_of_a_quarter_second(make_rig, seed):
    rig = make_rig(seed, paced=True)
    rig.session.connect()
    assert rig.armed()
    rig.up.loss = rig.down.loss = 0.05
    job = rig.begin(2000, dark_us=2400)
    assert rig.until(lambda: job.is_finished, 20.0), rig.session.board
    assert [entry["state"] for entry in rig.log if entry["event"] == "state"][-2:] == ["RUNNING", "ARMED"]
    rig.session.close()
    assert rig.check() == 2000
    print(f"{rig.faults} faults of {rig.up.frames + rig.down.frames} frames")
    assert rig.faults > 30


def played_in_s(loss, seed):
    """Return the duration of 2,000 points on the board, one every 0.55 ms."""
    rig = VirtualRig(seed, paced=True)
    rig.session.connect()
    assert rig.armed()
    rig.up.loss = rig.down.loss = loss
    job = rig.begin(2000)
    assert rig.until(lambda: job.is_finished, 20.0)
    pulses = [entry for entry in rig.log if entry["event"] == "pulse"]
    rig.session.close()
    assert rig.check() == 2000
    return (pulses[-1]["off_us"] - pulses[0]["on_us"]) * 1e-6


@pytest.mark.parametrize("runs", [1, pytest.param(6, marks=pytest.mark.slow)])
def test_goodput_of_a_job_at_one_percent_loss(runs):
    clean_s = played_in_s(0.0, 0)
    goodput = [clean_s / played_in_s(0.01, seed) for seed in range(1, runs + 1)]
    print(f"1,800 points/s at 1 % loss: {min(goodput):.1%} of the clean goodput at worst")
    assert min(goodput) >= 0.95


LINES = {115_200: 6000, 1_000_000: 20_000}
"""Baud rates, and numbers of points that saturate the line for some time."""


def filled_in_s(baud, loss, seed):
    """Return the time in which a saturated line delivers points to a board with a large queue, all acknowledged.

    With a lease of half a second: of 100 ms, 115,200 baud lose one after the other too often.
    """
    config, limits = configured(0.5, baud), replace(DEFAULT_LIMITS, lease_ms=500)
    rig = VirtualRig(seed, paced=True, config=config, queue_points=30_000, limits=limits)
    rig.session.connect()
    assert rig.armed()
    rig.up.loss = rig.down.loss = loss
    began_s = rig.clock.now_s()
    job = rig.session.begin(rig.points.make(LINES[baud]), rig.session.board_s() + 60.0, inf)
    assert rig.until(lambda: job.is_fully_sent and rig.session.is_acknowledged, 50.0)
    took_s = rig.clock.now_s() - began_s
    rig.session.close()
    rig.check()
    return took_s


@pytest.mark.parametrize("runs", [1, pytest.param(10, marks=pytest.mark.slow)])
@pytest.mark.parametrize("baud", LINES)
def test_goodput_of_a_full_line_at_one_percent_loss(baud, runs):
    """The throughput is relative to a line without loss. Each lost frame costs those behind it."""
    clean_s = filled_in_s(baud, 0.0, 0)
    assert clean_s < 1.1 * LINES[baud] * (FRAME_BYTES / 24) * BITS_PER_BYTE / baud, "the line was not full"
    lossy_s = [filled_in_s(baud, 0.01, seed) for seed in range(1, runs + 1)]
    goodput = clean_s * len(lossy_s) / sum(lossy_s)
    print(f"a full line of {baud} baud at 1 % loss: {goodput:.1%}, at worst {clean_s / max(lossy_s):.1%}")
    assert goodput >= 0.95


# --- ABORT behind what is in flight ---------------------------------------------------------------------------------


MOMENTS = [(3, 19), pytest.param(range(7, 35, 4), marks=pytest.mark.slow)]
"""Numbers of executed points at an abort."""


def off_after_abort_s(make_rig, baud, moments):
    """Return the maximum time from an abort on a saturated line to gate off, s."""
    return max(off_after_abort_at_s(make_rig, baud, executed) for executed in moments)


def off_after_abort_at_s(make_rig, baud, executed):
    config, limits = configured(0.5, baud), replace(DEFAULT_LIMITS, lease_ms=500)
    rig = make_rig(1, paced=True, config=config, limits=limits)
    rig.session.connect()
    assert rig.armed()
    job = rig.begin(
        4000, dark_us=4500, ahead_s=inf
    )  # slow pulses, so that the line is saturated until all points have arrived
    assert rig.until(lambda: job.executed_count > executed and rig.core.gate, 10.0)
    assert not job.is_fully_sent
    aborted_s = rig.clock.now_s()
    rig.session.abort()
    assert rig.until(lambda: rig.core.state == "DISARMED", 1.0)
    assert not rig.core.gate
    return [entry["t_us"] for entry in rig.log if entry["event"] == "state"][-1] * 1e-6 - aborted_s


def abort_bound_s(baud):
    """Return the transmission time of the permitted data in flight, plus 5 ms."""
    return max(2 * FRAME_BYTES * BITS_PER_BYTE / baud, 0.02) + 0.005


@pytest.mark.parametrize("moments", MOMENTS)
@pytest.mark.parametrize("baud", LINES)
def test_an_abort_takes_effect_5_ms_after_the_data_in_flight(make_rig, baud, moments):
    dark_s = off_after_abort_s(make_rig, baud, moments)
    print(f"{baud} baud: dark {dark_s * 1e3:.1f} ms after an abort, of {abort_bound_s(baud) * 1e3:.1f}")
    assert dark_s <= abort_bound_s(baud)


def test_a_host_that_keeps_more_in_flight_is_detected(monkeypatch):
    monkeypatch.setattr(arming, "MAX_IN_FLIGHT_S", 0.1)
    assert off_after_abort_s(VirtualRig, 115_200, (3, 19)) > abort_bound_s(115_200)


# --- a host that stalls ---------------------------------------------------------------------------------------------


def stalled(make_rig, for_s, ahead_s):
    """Stall a host with a lease of half a second during a job. Return the rig and the job."""
    rig = make_rig(1, config=configured(lease_s=0.5), limits=replace(DEFAULT_LIMITS, lease_ms=500))
    rig.session.connect()
    assert rig.armed()
    job = rig.begin(2000, dark_us=900, ahead_s=ahead_s)
    assert rig.until(lambda: job.executed_count > 500, 5.0)
    rig.clock.sleep(for_s)
    rig.core.advance(round(rig.clock.now_s() * 1e6))
    return rig, job


def test_a_stall_of_a_quarter_second_has_no_effect(make_rig):
    rig, job = stalled(make_rig, 0.25, ahead_s=0.5)
    assert rig.core.state == "RUNNING"
    assert rig.until(lambda: job.is_finished, 10.0)
    assert "HOLD" not in [entry["state"] for entry in rig.log if entry["event"] == "state"]
    rig.session.close()
    assert rig.check() == 2000


def test_a_stall_longer_than_the_queue_is_a_hold_that_resumes(make_rig):
    rig, job = stalled(make_rig, 0.4, ahead_s=0.25)
    assert rig.core.state == "HOLD"
    assert not rig.core.gate
    assert rig.until(lambda: job.is_finished, 10.0)
    rig.session.close()
    assert rig.check() == 2000


def test_a_stall_longer_than_the_lease_is_a_fault_that_does_not_resume(make_rig):
    rig, job = stalled(make_rig, 0.7, ahead_s=inf)
    assert (rig.core.state, rig.core.fault) == ("FAULT", "LINK")
    assert not rig.core.gate
    assert not rig.until(lambda: job.is_finished or rig.core.state != "FAULT", 3.0)
    rig.session.close()
    assert 500 < rig.check() < 2000
