"""The campaign's loop: what it plays, what it keeps, and when it ends. The diagnosis is a scripted one."""

from dataclasses import fields, replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError, RefusedError
from optodrive.core.types.discrepancy import Discrepancy, NextExperiment, Probabilities
from optodrive.core.types.measurements import Run, Signal
from optodrive.lab.live_diagnosis import (
    FIRST_ORDER,
    LEAD_S,
    POWER_MIN,
    REPEATS_MAX,
    CampaignRecording,
    find_pixels,
    name_probabilities,
    plan_experiment,
    plan_first_experiments,
    plan_proposal,
    run_campaign,
)
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.limiter import limit

DISPLAY = DISPLAYS["display-16"]
PIXELS = find_pixels(DISPLAY.config)
PROPOSED = NextExperiment(
    "one pulse", np.array([[0.02, 0.01, 2.0, float(PIXELS[0])]]), PIXELS[0], 9, ("displacement_m",), 24.0, 20.0
)
RUN_S = 10.0


class Bench:
    """Measures nothing but time."""

    def __init__(self, fails_after=None):
        self.clock_s, self.played, self.emits, self.fails_after = 0.0, [], False, fails_after

    def now_s(self):
        return self.clock_s

    def measure(self, experiment):
        if len(self.played) == self.fails_after:
            raise RefusedError("the power is off")
        self.emits = True
        self.played.append(experiment)
        self.clock_s += RUN_S
        t_s = np.linspace(0.0, experiment.span_s, 50)
        return Run("", 293.0, experiment.pulses, {"displacement_m": Signal(experiment.pixel, t_s, np.sin(t_s))})

    def run_elsewhere(self, function, *arguments):
        return function(*arguments)

    def disarm(self):
        self.emits = False


def explain(no_effect, proposal):
    """Return a diagnosis that names nothing, in what the loop reads."""
    probabilities = Probabilities(no_effect, 1.0 - no_effect, {("gas_leak",): 0.0})
    unread = dict.fromkeys(item.name for item in fields(Discrepancy))
    known = {"verdict": "none", "causes": (), "probabilities": probabilities, "next_experiment": proposal}
    return Discrepancy(**unread | known)


def run(bench, path, answers, budget_s=1e6):
    """Run a campaign whose diagnoses are scripted. Return its result."""
    script = iter(answers)

    def study(measurement, config):
        assert not bench.emits
        return next(script)

    recording = CampaignRecording(path, DISPLAY.config.name)
    return run_campaign(bench, DISPLAY, PIXELS, recording, study, budget_s, lambda _: None, lambda _: None)


def test_the_first_experiments_then_the_proposed_one_until_one_explanation_is_certain(tmp_path):
    bench = Bench()
    result = run(bench, tmp_path / "live.h5", [explain(0.5, PROPOSED), explain(0.96, PROPOSED)])
    assert result.ended == "certain"
    names = [experiment.name for experiment in bench.played]
    assert names[: len(FIRST_ORDER)] == list(FIRST_ORDER)
    assert len(names) == len(FIRST_ORDER) + REPEATS_MAX
    assert len(set(names[len(FIRST_ORDER) :])) == 1
    assert [step.runs for step in result.steps] == [len(FIRST_ORDER), len(names)]
    assert result.steps[1].played == tuple(names[len(FIRST_ORDER) :])


def test_it_ends_without_a_proposal_and_with_the_time(tmp_path):
    assert run(Bench(), tmp_path / "a.h5", [explain(0.5, None)]).ended == "no_proposal"
    bench = Bench()
    budget_s = RUN_S * (len(FIRST_ORDER) + 2.5)
    result = run(bench, tmp_path / "b.h5", [explain(0.5, PROPOSED)] * 2, budget_s)
    assert result.ended == "budget"
    assert bench.now_s() <= budget_s
    assert len(bench.played) == len(FIRST_ORDER) + 2


@pytest.mark.parametrize("count", [1, 4, len(FIRST_ORDER) - 1])
def test_every_finished_run_is_in_the_file_and_a_second_call_plays_what_lacks(tmp_path, count):
    path = tmp_path / "live.h5"
    with pytest.raises(RefusedError, match="the power is off"):
        run(Bench(fails_after=count), path, [])
    assert [item.attributes["group"] for item in CampaignRecording(path, DISPLAY.config.name).runs] == list(
        FIRST_ORDER[:count]
    )
    bench = Bench()
    run(bench, path, [explain(0.96, None)])
    groups = [item.attributes["group"] for item in CampaignRecording(path, DISPLAY.config.name).runs]
    assert sorted(groups) == sorted(FIRST_ORDER)
    assert len(bench.played) == len(FIRST_ORDER) - count


def test_a_recording_of_another_display_is_refused(tmp_path):
    path = tmp_path / "live.h5"
    run(Bench(), path, [explain(0.96, None)])
    with pytest.raises(InputError, match=r"live.h5: run000-ladder: display: got 'display-16', expected 'other'"):
        CampaignRecording(path, "other")


def test_probabilities_are_named_most_probable_first():
    named = name_probabilities(Probabilities(0.1, 0.2, {("gas_leak",): 0.3, ("gas_leak", "radiation"): 0.4}))
    assert list(named.items()) == [
        ("gas_leak and radiation", 0.4),
        ("gas_leak", 0.3),
        ("none of these causes", 0.2),
        ("no effect", 0.1),
    ]


@pytest.mark.parametrize("name", sorted(DISPLAYS))
def test_first_experiments_fit_every_cap_of_every_display(name):
    display = DISPLAYS[name]
    pixel, neighbour = find_pixels(display.config)
    assert (pixel == neighbour) == (len(display.layout) == 1)
    for experiment in plan_first_experiments(display, pixel, neighbour).values():
        limited, _ = limit(experiment.plan, display.build_cold_state()[1], display.budget, "refuse")
        assert not limited.trimmed_j.any()
        assert experiment.pulses[0, 0] == pytest.approx(LEAD_S)
        assert experiment.span_s > experiment.pulses[-1, 0] + experiment.pulses[-1, 1]


def use_laser(**keys):
    """Return the display with another laser."""
    table = DISPLAY.config.model_dump()
    config = type(DISPLAY.config).model_validate(table | {"laser": table["laser"] | keys})
    return DisplayModel.from_config(config)


def test_no_experiment_is_weaker_than_the_laser_emits():
    weak = use_laser(threshold_w=1.0)
    for experiment in plan_first_experiments(weak, *PIXELS).values():
        assert experiment.plan.power_w.min() >= 1.0
    below = np.array([[0.02, 0.05, 0.9, PIXELS[0]]])
    with pytest.raises(RefusedError, match="weaker"):
        plan_experiment(weak, "dark", below, PIXELS[0])
    with pytest.raises(InputError, match=r"laser\.modulation: got 'on_off', expected 'pwm': a diagnosis"):
        plan_first_experiments(use_laser(modulation="on_off"), *PIXELS)


def test_a_proposal_above_a_cap_is_played_with_less_power():
    hot = replace(PROPOSED, pulses=np.array([[0.02, 0.05, 10.0 * DISPLAY.config.laser.max_power_w, PIXELS[0]]]))
    experiment = plan_proposal(DISPLAY, hot)
    assert 0.0 < experiment.pulses[0, 2] <= DISPLAY.config.laser.max_power_w
    assert experiment.name == plan_proposal(DISPLAY, hot).name != plan_proposal(DISPLAY, PROPOSED).name
    too_hot = np.array([[0.02, 0.05, 2.0 / POWER_MIN * DISPLAY.config.laser.max_power_w, PIXELS[0]]])
    with pytest.raises(RefusedError):
        plan_experiment(DISPLAY, "burns", too_hot, PIXELS[0])
