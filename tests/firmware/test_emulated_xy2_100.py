"""The Pico's frames of XY2-100 in the emulator: a decoder beside the chip judges every one by clock, SYNC, X and Y.

`python -m pytest -m slow tests/firmware/test_emulated_xy2_100.py -k minute` judges 6 million of them, in pieces of ten
seconds of the chip's time, each of which `-k minute-K` runs alone.
"""

from functools import partial
from itertools import groupby

import numpy as np
import pytest
from bench import PATIENT, Bench, act, here
from emulated_pico import EmulatedPico, PicoImage
from test_emulated_pico import check_edges
from virtual_board import PicoBoard, VirtualKind

FRAME_US = 10
PIECES, PIECE_S = 6, 10.0


@pytest.fixture(scope="session")
def image(tmp_path_factory):
    return PicoImage(tmp_path_factory.mktemp("xy2-100"), interface="xy2-100")


@pytest.fixture
def bench(image, tmp_path):
    bench = Bench(VirtualKind("xy2-100", partial(EmulatedPico, image), make_board=PicoBoard), tmp_path)
    yield bench
    bench.finish(lambda board: None)


def draw_points(count, seed):
    """Return points at random places, each with a short pulse."""
    places = np.random.default_rng(seed).integers(0, 65536, (count, 2)).tolist()
    return [here(100, x=x, y=y, dark_us=200, duty=999) for x, y in places]


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
    assert host.play(*points) == []
    host.wait_for_change("job done")
    check_places(core, points)
    arrived_us = np.array([at_us for at_us, *_ in core.mirrors])
    late_us = arrived_us[1:] - core.moves_us[-len(points) :]
    assert FRAME_US < late_us.min() < late_us.max() < 2 * FRAME_US
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
    core = EmulatedPico(PicoImage(tmp_path, mutant, interface="xy2-100"), None, lambda entry: None, 1)
    core.advance(20_000)
    core.count_frames()
    assert expected <= {what for _, what in core.frame_errors}
    with pytest.raises(AssertionError):
        check_frames(core, 6_000)
    core.close()


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("piece", range(1, PIECES + 1), ids="minute-{}".format)
def test_an_emulated_minute_has_no_gap(bench, piece):
    host = bench.ready(settle_us=50, settle_ns_per_code=0, spot_leak_uw=4_000_000_000, **PATIENT)
    core = host.board.core
    points = draw_points(int((PIECE_S - 2.2) / 300e-6), piece)
    assert host.play(*points[:1000], end=False) == []
    at = 1000
    while at < len(points):
        if at < len(host.board.of("pulse")) + 1800:
            assert host.send_checked("DATA", first_index=at, points=points[at : at + 24]) == []
            at += 24
        else:
            host.pause(0.02)
    host.send("END", job=1, end_index=len(points))
    host.wait_for_change("job done")
    core.advance(max(1e6 * PIECE_S, core.chip_us))
    check_places(core, points)
    check_frames(core, core.mirrors[0][0])
    print(f"{core.count_frames()} frames, {len(points)} positions")
