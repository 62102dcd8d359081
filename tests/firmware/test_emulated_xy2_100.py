"""The Pico's frames of XY2-100 in the emulator: a decoder beside the chip judges every one by clock, SYNC, X and Y.

`python -m pytest -m slow tests/firmware/test_emulated_xy2_100.py -k minute` judges 6 million of them, in pieces of ten
seconds of the chip's time, each of which `-k minute-K` runs alone.
"""

from functools import partial
from itertools import groupby

import numpy as np
import pytest
from bench import BRIGHT, PATIENT, Bench, act, here
from emulated_pico import STATUS_OK, EmulatedDigitalPico, PicoImage, encode_status
from test_emulated_pico import check_edges
from virtual_board import PicoBoard, VirtualKind

FRAME_US = 10
PIECES, PIECE_S = 6, 10.0


@pytest.fixture(scope="session")
def image(tmp_path_factory):
    return PicoImage(tmp_path_factory.mktemp("xy2-100"))


@pytest.fixture
def bench(image, tmp_path):
    bench = Bench(VirtualKind("xy2-100", partial(EmulatedDigitalPico, image), make_board=PicoBoard), tmp_path)
    yield bench
    bench.finish(lambda board: None)


def draw_points(count, seed, dark_us=200):
    """Return points at random places, each with a short pulse."""
    places = np.random.default_rng(seed).integers(0, 65536, (count, 2)).tolist()
    return [here(100, x=x, y=y, dark_us=dark_us, duty=999) for x, y in places]


def check_frames(core, since_us):
    """Check that each 10 µs since a time had its frame, and that none was wrong."""
    frames = core.count_frames()
    assert core.frame_errors == []
    assert frames == pytest.approx((core.chip_us - since_us) / FRAME_US, abs=1)


def check_places(core, points):
    """Check the places that the head was sent after the first one, the centre, against those of points."""
    sent = [(x, y) for _, x, y in core.mirrors]
    assert sent == [place for place, _ in groupby([(32768, 32768), *(point[:2] for point in points)])]


def test_each_10_us_have_a_frame_with_the_position_of_the_points_even_when_the_core_has_stopped(bench):
    host = bench.ready(act("stop_tick"), settle_us=50, settle_ns_per_code=0, spot_leak_uw=4_000_000_000, **PATIENT)
    core, points = host.board.core, draw_points(500, 1)
    core.play_every_frame()
    assert host.play(*points) == []
    host.wait_for_change("job done")
    check_places(core, points)
    arrived_us = np.array([at_us for at_us, *_ in core.mirrors])
    late_us = arrived_us[1:] - core.moves_us[-len(points) :]
    # A frame's last bit is read 9.75 µs after the frame begins. Its position is fetched 0.25 µs before or less.
    assert FRAME_US - 0.5 < late_us.min() < late_us.max() < 2 * FRAME_US
    on_us, off_us = (np.array([at_us for at_us, is_on, _ in core.pins if is_on == on]) for on in (True, False))
    assert (arrived_us[1:] < on_us).all()
    assert (off_us[:-1] < arrived_us[2:] - FRAME_US).all(), "no frame of the next place begins in a pulse"
    check_edges(core, host.board)
    host.board.next_step()
    core.advance(host.clock.now_us() + 30_000)
    check_frames(core, arrived_us[0])
    check_places(core, points)


@pytest.mark.parametrize(
    ("mutant", "expected"),
    [
        (111, {"x: parity", "y: parity"}),
        (112, {"x: control bits", "y: control bits"}),
        (113, set()),
        (114, {"19 bits"}),
    ],
    ids=["parity inverted", "control bits wrong", "frames dropped", "a bit short"],
)
def test_wrong_frames_are_detected(tmp_path, mutant, expected):
    core = EmulatedDigitalPico(PicoImage(tmp_path, mutant), None, lambda entry: None, 1)
    core.advance(20_000)
    core.count_frames()
    assert expected <= {what for _, what in core.frame_errors}
    with pytest.raises(AssertionError):
        check_frames(core, 6_000)
    core.close()


GOOD = encode_status(STATUS_OK)
BAD_ANSWERS = {
    "silent, low": {"frame": None, "line": False},
    "silent, high": {"frame": None, "line": True},
    "parity": {"frame": GOOD ^ 1},
    "control bits": {"frame": GOOD ^ 3 << 17},
    "no power": {"frame": encode_status(STATUS_OK & ~0x8080)},
    "too warm": {"frame": encode_status(STATUS_OK & ~0x4040)},
}
HEAD_MAX_US = 200


def change_answer(host, kind, wait_us):
    """Let the head of an idle board answer badly after a time. Return how long the fault took, µs."""
    core, log = host.board.core, host.board
    core.advance(host.clock.now_us() + wait_us)
    count, since_us = len(log.of("fault")), core.chip_us
    core.answer(**BAD_ANSWERS[kind])
    core.advance(since_us + HEAD_MAX_US + FRAME_US)
    assert [each["fault"] for each in log.of("fault")[count:]] == ["HEAD"], kind
    return log.of("fault")[-1]["t_us"] - since_us


def repair(host):
    """Let the head answer as it did, and clear the fault."""
    host.board.core.answer(frame=GOOD)
    host.pause(0.001)
    assert host.send_checked("CLEAR_FAULT") == []


def test_each_bad_status_is_a_fault_within_200_us_and_a_single_one_is_none(bench):
    host = bench.greeted()
    core = host.board.core
    slowest_us = 0
    for kind in BAD_ANSWERS:
        for wait_us in range(0, 100, 34):
            slowest_us = max(slowest_us, change_answer(host, kind, wait_us))
            repair(host)
    print(f"fault HEAD after {slowest_us} µs at most")
    assert slowest_us <= HEAD_MAX_US
    faults = len(host.board.of("fault"))
    for _ in range(50):
        core.answer(bad=1)
        core.advance(core.chip_us + 137)
    assert len(host.board.of("fault")) == faults
    assert host.status().head == STATUS_OK


def test_a_board_that_ignores_the_status_is_detected(tmp_path):
    kind = VirtualKind("mutant", partial(EmulatedDigitalPico, PicoImage(tmp_path, 16)), make_board=PicoBoard)
    bench = Bench(kind, tmp_path)
    host = bench.greeted()
    for each in BAD_ANSWERS:
        with pytest.raises(AssertionError, match=each):
            change_answer(host, each, 0)
    bench.finish(lambda board: None)


@pytest.mark.parametrize(
    "kind", [pytest.param(each, marks=() if each == "silent, low" else pytest.mark.slow) for each in BAD_ANSWERS]
)
def test_a_head_that_is_not_ready_turns_the_gate_off_within_200_us(bench, kind):
    host = bench.ready(**BRIGHT)
    host.shine()
    core, since_us = host.board.core, host.board.core.chip_us
    core.answer(**BAD_ANSWERS[kind])
    core.advance(since_us + 1000)
    assert host.board.states()[-1] == ("FAULT", "fault")
    off_us, is_on, _ = core.pins[-1]
    assert not is_on
    assert 0 < off_us - since_us <= HEAD_MAX_US
    print(f"gate off {off_us - since_us:.0f} µs after the status")


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("piece", range(1, PIECES + 1), ids="minute-{}".format)
def test_an_emulated_minute_has_no_gap(bench, piece):
    host = bench.greeted(settle_us=50, settle_ns_per_code=0, spot_leak_uw=4_000_000_000, **PATIENT)
    core = host.board.core
    core.play_every_frame()
    host.arm()
    points = draw_points(int((PIECE_S - 2.5) / 500e-6), piece, dark_us=400)
    assert host.play(*points[:960], end=False) == []
    while host.index < len(points):
        host.lease()
        host.receive()
        while host.index < min(len(points), len(host.board.of("pulse")) + 1500):
            host.raw(host.data(*points[host.index : host.index + 24]))
    assert host.send_checked("END", job=1, end_index=len(points)) == []
    host.wait_for_change("job done")
    core.advance(max(1e6 * PIECE_S, core.chip_us))
    check_places(core, points)
    check_frames(core, core.mirrors[0][0])
    print(f"{core.count_frames()} frames, {len(points)} positions")
