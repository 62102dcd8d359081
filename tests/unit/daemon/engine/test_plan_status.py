"""The transitions of a plan's status: every end is final, and a wrong change is refused by name."""

from itertools import product

import pytest

from optodrive.daemon.engine.plan_record import PlanRecord
from optodrive.daemon.responses.plan import ENDS, TRANSITIONS, PlanStatus

FORBIDDEN = [pair for pair in product(PlanStatus, PlanStatus) if pair[1] not in TRANSITIONS[pair[0]]]


def build_record(status):
    return PlanRecord("p1", "push", 1, 0.1, b"{}", None, None, 0.0, 0.0, status=status)


def test_every_status_is_reached_from_planned_and_reaches_an_end():
    reached = {PlanStatus.PLANNED}
    for _ in PlanStatus:
        reached |= {after for before in reached for after in TRANSITIONS[before]}
    assert reached == set(PlanStatus)
    assert {status for status in PlanStatus if not TRANSITIONS[status]} == set(ENDS)


@pytest.mark.parametrize(("before", "after"), FORBIDDEN)
def test_a_wrong_change_is_refused(before, after):
    record = build_record(before)
    with pytest.raises(ValueError, match=f"plan p1 is {before}, and cannot become {after}"):
        record.change_status(after)
    assert record.status is before


def test_a_plan_is_paused_goes_on_and_ends():
    record = build_record(PlanStatus.PLANNED)
    for status in (PlanStatus.QUEUED, PlanStatus.RUNNING, PlanStatus.PAUSED, PlanStatus.RUNNING, PlanStatus.DONE):
        assert not record.has_ended
        record = record.change_status(status)
    assert record.has_ended
