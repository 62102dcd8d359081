"""A core with small tables: pulses that it cannot account for are not emitted."""

from functools import partial

import pytest
from board_bench import here
from c_board import CBench


@pytest.fixture
def small(libraries):
    return partial(CBench, libraries(0, "BOARD_CELLS=4", "BOARD_PULSES=8", "BOARD_QUEUE_POINTS=24", "BOARD_RECORDS=16"))


def row(count, dark_us=0):
    return [here(100, x=1000 + 2000 * k, duty=999, dark_us=dark_us) for k in range(count)]


def test_more_warm_cells_than_accounts_is_a_fault(small):
    b = small({"spot_leak_uw": 0}, queue_points=24).ready()
    b.play(*row(5))
    b.wait(10_000)
    assert (b.fault, len(b.pulses)) == ("SPOT", 4)


def test_cells_that_have_cooled_give_their_accounts_back(small):
    b = small(queue_points=24).ready()
    b.play(*row(6, dark_us=5000))
    b.wait(50_000)
    assert (b.fault, len(b.pulses)) == ("", 6)


def test_more_pulses_in_a_second_than_are_remembered_is_a_fault(small):
    b = small(queue_points=24).ready()
    b.play(*[here(100, duty=99, dark_us=1000)] * 9)
    b.wait(20_000)
    assert (b.fault, len(b.pulses)) == ("MEAN_POWER", 8)


def test_reports_come_before_their_records_are_overwritten(small):
    b = small(queue_points=24).ready()
    answers = b.play(*[here(0, dark_us=400, duty=0)] * 24)
    answers += [x for _ in range(40) for x in b.wait(500)]
    reported = [x.first_index + k for x in answers if hasattr(x, "records") for k in range(len(x.records))]
    assert reported == list(range(24))
