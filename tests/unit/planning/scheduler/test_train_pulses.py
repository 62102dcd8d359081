import pytest

from optodrive.core.types.stimuli import HeightTrain, PulseTrain
from optodrive.planning.scheduler import train_pulses
from optodrive.planning.scheduler.train_pulses import list_train_pulses

TRAINS = (
    PulseTrain(7, 0.0, 1.0, 0.01, 0.01, 1.0),
    HeightTrain(2, 0.0, 1.0, 0.02, 5e-5),
    PulseTrain(3, 0.005, 1.0, 0.004, 0.003, 0.5),
)


def test_the_pulses_of_all_trains_are_in_order_of_time_and_of_the_trains():
    pulses = list_train_pulses(dict(enumerate(TRAINS, 4)))
    assert len(pulses) == 50 + 50 + 143
    assert [pulse[:2] for pulse in pulses] == sorted(pulse[:2] for pulse in pulses)
    assert pulses[:2] == [(0, 4, 7, 10_000, 1.0), (0, 5, 2, 0, 0.0)]
    assert all(type(value) is int for value in pulses[0][:4])
    assert list_train_pulses({}) == []


@pytest.mark.parametrize("pulses_per_report", [1, 100])
def test_long_lists_report_progress(monkeypatch, pulses_per_report):
    monkeypatch.setattr(train_pulses, "PROGRESS_PULSES", pulses_per_report)
    reports = []
    pulses = list_train_pulses(dict(enumerate(TRAINS)), lambda: reports.append(1))
    assert len(reports) >= len(pulses) / pulses_per_report
