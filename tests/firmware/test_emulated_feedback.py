"""B17 on the emulated Pico: its ADC reads position outputs with noise and disturbed readings.

`python -m pytest -s -m slow tests/firmware/test_emulated_feedback.py` plays a minute without a false stop.
"""

from functools import partial
from itertools import pairwise

import pytest
from bench import BRIGHT, Bench, here
from emulated_pico import EmulatedPico, PicoImage
from virtual_board import PicoBoard, VirtualKind

from optodrive.link.simulator.measured_mirrors import MIRROR_FAULTS

CODES = 850
"""Half a cell of the shipped displays."""
LEFT, RIGHT = 22_768, 42_768
OFF_MAX_US = 1000
PLACES = (LEFT, LEFT), (RIGHT, LEFT), (RIGHT, RIGHT), (LEFT, RIGHT)
JUMPS, LONG_JUMPS = ([here(on_us, duty=2000, x=x, y=y) for x, y in PLACES] for on_us in (4_000, 20_000))
STATUS_CODES = 150
"""A measured position is this near: a step of the ADC is 20 codes, the noise ± 6 of them."""


@pytest.fixture(scope="session")
def image(tmp_path_factory):
    return PicoImage(tmp_path_factory.mktemp("feedback"))


def start(image, tmp_path, points):
    """Return a bench and its host, whose armed board measures the mirrors and plays points."""
    bench = Bench(VirtualKind("pico", partial(EmulatedPico, image), make_board=PicoBoard), tmp_path)
    host = bench.greeted(feedback_codes=CODES, **BRIGHT)
    host.pause(0.01)
    host.arm()
    assert host.play(*points, end=False) == []
    host.wait(host.board.is_gate_on, "light")
    return bench, host


def break_mirror(host, fault, wait_us):
    """Break mirror x a time after a pulse begins. Return how long light then is beside its position, µs."""
    core, board = host.board.core, host.board
    host.pause(0.02)
    host.wait(lambda: not board.is_gate_on(), "the next move", lease=False)
    host.wait(board.is_gate_on, "the next pulse", lease=False)
    core.advance(core.chip_us + wait_us)
    x, fault_us = core.mirrors[-1][1], core.chip_us
    core.inject_fault(fault)
    core.advance(core.chip_us + 80_000)
    assert board.faults() == ["SCAN"]
    assert not core.gate
    beside_us = 0.0
    edges = [(at_us, on) for at_us, on, _ in core.pins]
    for (on_us, is_on), (off_us, _) in pairwise(edges):
        if is_on and off_us > fault_us:
            place = [mirror for mirror in core.mirrors if mirror[0] <= on_us][-1][1]
            if fault == "unplug_mirror" or abs(place - x) > CODES:
                beside_us = max(beside_us, off_us - max(on_us, fault_us))
    return beside_us


@pytest.mark.parametrize(
    "fault", [pytest.param(each, marks=() if each == "unplug_mirror" else pytest.mark.slow) for each in MIRROR_FAULTS]
)
def test_a_mirror_that_ceases_to_follow_turns_the_gate_off_within_a_millisecond(image, tmp_path, fault):
    bench, host = start(image, tmp_path, LONG_JUMPS * 20)
    status = host.status()
    assert abs(status.mirror_y - LEFT) < STATUS_CODES or abs(status.mirror_y - RIGHT) < STATUS_CODES
    beside_us = break_mirror(host, fault, 137)
    print(f"{fault}: light beside its position for {beside_us:.0f} µs")
    assert beside_us <= OFF_MAX_US
    if fault == "unplug_mirror":
        assert beside_us > 0, "the pulse that was lit"
        assert host.status().mirror_x == 65535
    bench.finish(lambda board: None)


@pytest.mark.slow
def test_a_board_that_ignores_the_mirrors_is_detected(tmp_path):
    bench, host = start(PicoImage(tmp_path, 17), tmp_path, LONG_JUMPS * 20)
    with pytest.raises(AssertionError):
        break_mirror(host, "stick_mirror", 137)
    bench.finish(lambda board: None)


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_no_false_stop_in_a_minute(image, tmp_path):
    """One reading in 61 is wrong: 197,000 of them."""
    bench, host = start(image, tmp_path, JUMPS * 200)
    end_s = host.clock.now_s() + 60.0
    while host.clock.now_s() < end_s:
        status = host.status()
        if status.queued < 400:
            assert host.order(*[host.data(*JUMPS * 6) for _ in range(20)]) == []
        host.pause(0.1)
    assert host.board.faults() == []
    print(f"{len(host.board.of('pulse'))} pulses without a fault")
    assert len(host.board.of("pulse")) > 10_000
    bench.finish(lambda board: None)
