"""Stimuli on simulated boards in virtual time, and the comparison of executed with planned pulses."""

from dataclasses import replace

import numpy as np
import pytest

from optodrive.core.errors import RefusedError
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.study.observers import Observer, Participant
from optodrive.study.presenter import VirtualPresenter
from optodrive.study.session import SimulatedRespondent, run_session
from optodrive.study.study_file import load_study
from optodrive.study.trial_list import ListedTrial
from optodrive.study.trial_log import TrialLog
from optodrive.study.trial_stimulus import build_stimulus

COMPARED = {"first": 10, "second": 200, "first_intensity": 6.0, "second_intensity": 8.0}


@pytest.fixture(scope="module")
def display():
    return DisplayModel.from_config(load_config())


def test_onsets_are_on_one_clock_of_the_board(display):
    study, trial = load_study("experiment-4"), ListedTrial("main", "main", False, {"level": 1})
    presenter = VirtualPresenter(display)
    shown = []
    for _ in range(2):
        shown.append(presenter.present(build_stimulus(study, trial, trial.condition, display.config)))
        presenter.wait(1.0)
    presenter.close()
    first, second = shown
    assert first.fault is second.fault is None
    assert second.onset_s > first.onset_s + first.duration_s + 1.0 > 2.0
    assert first.start_s == pytest.approx(0.05 * np.arange(20), abs=1e-6)
    assert first.power_w == pytest.approx(0.5, rel=1e-3)


class FaultyPresenter(VirtualPresenter):
    """Drops the last pulse of some presentations, as a board does that was reset."""

    faults = 0

    def present(self, stimulus, on_begin):
        shown = super().present(stimulus, on_begin)
        self.faults -= 1
        return shown if self.faults < 0 else replace(shown, pixel=shown.pixel[:-1], fault="19 of 20 pulses executed")


@pytest.mark.parametrize("faults", [1, 4])
def test_a_stimulus_that_was_not_as_requested_is_marked_and_repeated(display, tmp_path, faults):
    study = load_study("experiment-6").model_copy(update={"repetitions": 1, "familiarisation": False})
    presenter = FaultyPresenter(display)
    presenter.faults = faults
    respondent = SimulatedRespondent(Observer(study, display, Participant()), 0, 1, presenter)
    with TrialLog(tmp_path / "log.jsonl", study, "01") as log:
        run_session(study, log, presenter, respondent)
        assert [log.trials[index]["attempt"] for index in range(6)] == [faults + 1, 1, 1, 1, 1, 1]
    assert (tmp_path / "log.jsonl").read_text().count('"record": "spoiled"') == faults


def test_a_display_that_never_shows_it_as_requested_ends_the_run(display, tmp_path):
    study = load_study("experiment-6").model_copy(update={"repetitions": 1, "familiarisation": False})
    presenter = FaultyPresenter(display)
    presenter.faults = 5
    respondent = SimulatedRespondent(Observer(study, display, Participant()), 0, 1, presenter)
    with TrialLog(tmp_path / "log.jsonl", study, "01") as log:
        with pytest.raises(RefusedError, match="trial 1: 5 stimuli were not as requested"):
            run_session(study, log, presenter, respondent)
        assert not log.trials


@pytest.mark.parametrize(
    ("name", "condition", "has_height"),
    [("detection", {"side": "left", "power_mw": 900.0}, False), ("equalisation", COMPARED, True)],
)
def test_requested_and_executed_times_and_heights_are_recorded(display, name, condition, has_height):
    presenter, study = VirtualPresenter(display), load_study(name)
    stimulus = build_stimulus(study, ListedTrial("main", "main", False, condition), condition, display.config)
    shown = presenter.present(stimulus)
    presenter.close()
    t_s = np.arange(0.0, shown.duration_s + 0.05, 1e-4)
    pulses = np.column_stack([shown.start_s, shown.width_s, shown.power_w, shown.pixel])
    simulated_m = [display.build_cold_heat().simulate_displacement_m(pulses, int(k), t_s) for k in set(shown.pixel)]
    assert shown.height_m == pytest.approx(np.max(simulated_m), rel=1e-3)
    requested = shown.to_record()["requested"]
    assert requested["onset_s"] == pytest.approx(shown.onset_s, abs=2e-6)
    assert requested["duration_s"] == pytest.approx(shown.duration_s, abs=2e-6)
    heights_m = [train.target_m for train in stimulus.sequence.trains if hasattr(train, "target_m")]
    assert requested["height_m"] == (pytest.approx(max(heights_m)) if has_height else None)
    assert not has_height or shown.height_m == pytest.approx(max(heights_m), rel=0.05)
