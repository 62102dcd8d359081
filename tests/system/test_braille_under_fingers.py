"""`optodrive braille --fingers`: the cells of a screen reader stand, and dots under fingers are refreshed first."""

import json
from collections import Counter

import pytest

import braille_reader
from braille_desk import COUNT, PIXELS, SerialLine, running_desk
from rig import wait_for
from test_standing_frames import FAR_M, LEAD, PIXEL_OF, PLACES, place, socket

pytestmark = pytest.mark.skipif(
    not braille_reader.is_installed(), reason="BRLTTY is not installed: scripts/test-packages"
)
FULL = bytes([0b111111]) * COUNT
FINGER = PIXELS[COUNT // 2][1]


class TouchedLine(SerialLine):
    """One line of cells that stands."""

    def __init__(self, folder):
        super().__init__(folder)
        self.arguments.append("--fingers")


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    with running_desk(tmp_path_factory.mktemp("touched"), TouchedLine) as desk:
        yield desk


def count_pulses(board, since):
    return Counter(PIXEL_OF[pulse["x"], pulse["y"]] for pulse in board.of("pulse")[since:])


def test_cells_stand_come_back_after_stop_and_get_more_light_under_a_finger(desk):
    since, expected = desk.show(FULL)
    wait_for(lambda: min(count_pulses(desk.board, since)[pixel] for pixel in expected) >= 2, "every dot twice")
    assert desk.find_emitted(since) == expected
    desk.daemon.call("POST", "/v1/stop")
    desk.daemon.arm()
    since = len(desk.board.of("pulse"))
    wait_for(lambda: desk.find_emitted(since) == expected, "the cells again")
    since = len(desk.board.of("pulse"))
    with socket(desk.daemon, "/v1/fingers") as fingers:
        touched = json.dumps({"fingers": [place(FINGER)], "age_s": 0.0})

        def find_lead():
            fingers.send(touched)
            counts = count_pulses(desk.board, since)
            far = [pixel for pixel in expected if abs(PLACES[pixel][0] - PLACES[FINGER][0]) > FAR_M]
            return counts[FINGER] - max(counts[pixel] for pixel in far)

        wait_for(lambda: find_lead() >= LEAD, "more light under the finger")
    since, expected = desk.show(bytes(COUNT))
    assert expected == set()
