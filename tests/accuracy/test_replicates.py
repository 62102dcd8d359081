"""Evidence from repeats: certainty of the noise, steadiness of the power, forms of a cause."""

from dataclasses import replace

import numpy as np
import pytest

from labs import AMBIENT_K, PIXEL, lab
from optodrive.core.types.discrepancy import CandidateCause, NextExperiment
from optodrive.core.types.measurements import Measurement, Signal
from optodrive.lab.diagnosis import model_selection
from optodrive.lab.diagnosis.dataset import build_dataset
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.estimates import compute_discrepancy_basis
from optodrive.lab.diagnosis.evidence import (
    KNOWN_DEGREES,
    MAX_DEGREES,
    NoiseCertainty,
    compute_bin_evidence,
    count_noise_degrees,
    temper,
)
from optodrive.lab.diagnosis.fitting import compute_jitter_sensitivity, fit
from optodrive.lab.diagnosis.model_comparison import split_runs
from optodrive.lab.diagnosis.narrative import build_answer, build_narrative
from optodrive.lab.diagnosis.next_steps import propose_experiment
from optodrive.lab.diagnosis.noise_model import ColouredNoise
from optodrive.lab.diagnosis.nominal_fit import fit_nominal
from optodrive.lab.diagnosis.omnibus_test import assign_bins, compute_omnibus
from optodrive.lab.diagnosis.prediction import ParameterPoint, predict
from optodrive.physics.hypothesis import RecordingScope
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals
from optodrive.physics.terms import discover_terms

CLOCKS = ("temperature", "displacement", "force", "mirrors")
TEMPERATURE = "absorber_temperature_K"


def split_pulses(rng, pulses, size):
    """Split pulses into slices of about 10 ms with randomly higher or lower power."""
    rows = []
    for start_s, width_s, power_w, pixel in pulses:
        count = max(1, round(width_s / 0.01))
        powers = power_w * (1.0 + size * rng.choice([-1.0, 1.0], count))
        rows += [(start_s + k * width_s / count, width_s / count, powers[k], pixel) for k in range(count)]
    return np.array(rows)


def hopping_lab(seed, size=0.05):
    """Return a recording without hidden effects whose power fluctuates within pulses at random."""
    rng, runs = np.random.default_rng(seed), []
    for run in lab(seed, {}).runs:
        t_s = run.signals[TEMPERATURE].t_s
        real, meant = (
            simulate_signals(
                PixelExperiment(pulses, 0, AMBIENT_K, (t_s, t_s, np.zeros(0))), PIXEL, ActiveTerms.from_values({})
            )
            for pulses in (split_pulses(rng, run.pulses, size), run.pulses)
        )
        signals = {
            name: Signal(0, t_s, signal.value + real[kind] - meant[kind])
            for kind, (name, signal) in enumerate(run.signals.items())
        }
        runs.append(replace(run, signals=signals))
    return Measurement(tuple(runs))


@pytest.fixture(scope="module")
def hopping():
    return diagnose(hopping_lab(22))


@pytest.mark.parametrize("scale", [1.0, pytest.param(1.3, marks=pytest.mark.slow)])
def test_bins_of_noise_are_no_effect_whatever_the_noise_really_is(scale):
    rng = np.random.default_rng(1)
    gram = np.eye(150)
    gains = []
    for _ in range(400):
        noise_chi2 = scale**2 * rng.chisquare(80)
        gains.append(compute_bin_evidence(gram, scale * rng.standard_normal(150), noise_chi2, 80).log_evidence)
    assert np.mean(np.array(gains) > 0.0) < 0.05
    assert max(gains) < 7.0
    large = np.full(150, np.sqrt(3.0))
    assert compute_bin_evidence(gram, large, 80.0, 80).log_evidence > 10.0
    assert (
        compute_bin_evidence(gram, large, 0.0, 0).log_evidence
        > compute_bin_evidence(gram, large, 80.0, 80).log_evidence
    )


def test_odds_are_worth_less_the_fewer_contrasts_the_noise_comes_from():
    """Noise by ten contrasts: the mean of exp(temper) over data without an effect does not exceed the odds at stake."""
    rng = np.random.default_rng(2)
    ratios = rng.chisquare(1, 40_000) / (rng.chisquare(10, 40_000) / 10)
    for odds in (10.0, 100.0, 1000.0):
        surprising = [temper(0.5 * ratio, 10) > np.log(odds) for ratio in ratios]
        assert np.mean(surprising) < 1.0 / odds
    assert temper(12.5, 10) < 0.6 * temper(12.5, KNOWN_DEGREES)
    assert temper(0.01, 10) == pytest.approx(0.011, rel=0.01)


def test_bins_of_pure_noise_have_their_degrees_and_repeats_set_the_scale():
    problem, base = fit_nominal(build_dataset(lab(21, {}, repeats=2)))
    data, noise = problem.data, problem.noise
    plain = {
        kind: ColouredNoise(own.white, (1e-9 * own.white,) * 2, (1e-2, 1.0)) for kind, own in noise.coloured.items()
    }
    problem = replace(problem, noise=replace(noise, coloured=plain))
    shared = compute_jitter_sensitivity(data, base.point, base.prediction)
    rng = np.random.default_rng(3)
    residual, oscillation = np.zeros(len(data.value)), np.zeros(len(data.value))
    for block in data.blocks:
        white = plain[block.kind].white
        residual[block.part] = white * rng.standard_normal(len(block.t_s))
        oscillation[block.part] = white * np.sin(2.0 * np.pi * block.t_s / 0.03)
    found = compute_omnibus(problem, residual[:, None], shared)
    assert found.degrees > 60
    for chi2, degrees in ((found.chi2, found.degrees), (found.noise_chi2, found.noise_degrees)):
        assert abs(chi2 - degrees) < 4.5 * np.sqrt(2.0 * degrees)
    # Noise 1.5 times that of the model is no effect; a residual common to all repeats is one.
    assert compute_omnibus(problem, 1.5 * residual[:, None], shared).evidence.log_evidence < 2.0
    assert compute_omnibus(problem, (residual + 1.5 * oscillation)[:, None], shared).evidence.log_evidence > 8.0


def test_an_effect_that_all_groups_share_is_seen_in_their_joined_bins():
    problem, base = fit_nominal(build_dataset(lab(21, {}, repeats=2)))
    data, rng = problem.data, np.random.default_rng(4)
    jitter = compute_jitter_sensitivity(data, base.point, base.prediction)
    plain = {
        kind: ColouredNoise(own.white, (1e-9 * own.white,) * 2, (1e-2, 1.0))
        for kind, own in problem.noise.coloured.items()
    }
    problem = replace(problem, noise=replace(problem.noise, coloured=plain))
    joined = assign_bins(data).joined
    assert (np.count_nonzero(joined, axis=1) == 1).all()
    assert joined.max() == pytest.approx(1.0)
    noise, shared, alternating = (np.zeros(len(data.value)) for _ in range(3))
    for block in data.blocks:
        noise[block.part] = plain[block.kind].white * rng.standard_normal(len(block.t_s))
        if block.kind == 1:
            span = float(np.ptp(data.value[block.part]))
            shared[block.part] = span * (np.arange(len(block.t_s)) > 0.5 * len(block.t_s))
            alternating[block.part] = shared[block.part] * (-1.0) ** list(data.groups).index(data.runs[block.run].group)
    size = 0.5 * plain[1].white / shared.max()

    def compute_gains(effect):
        gains = compute_omnibus(problem, (noise + size * effect)[:, None], jitter).evidence.gains
        return [part.max() for part in np.split(gains, 2)]

    own, joint = compute_gains(shared)
    assert joint > own + 2.0
    assert compute_gains(alternating)[1] < 1.0


def test_a_late_clock_has_no_other_form_than_its_share_in_each_signal():
    scope = RecordingScope(CLOCKS[:3], (0,), frozenset({0}), False, 3)
    every = {key: discover_terms()[key].build_hypotheses(scope) for key in ("clock_offset", "laser_lag")}
    data = build_dataset(lab(21, {}, repeats=2))
    problem, base = fit_nominal(data)
    for key, is_free in (("clock_offset", False), ("laser_lag", True)):
        item = every[key][0]
        point = ParameterPoint(base.point.base, {key: dict(item.starts[0])})
        fitted = replace(base, point=point, prediction=predict(data, point))
        columns = compute_discrepancy_basis(problem, fitted, (item,), every[key])
        assert (columns.shape[1] > len(data.kinds) - 1) == is_free


def test_power_that_hops_within_pulses_is_not_named(hopping):
    assert (hopping.verdict, hopping.causes) == ("unexplained", ())
    assert any("the power fluctuates within pulses" in line for line in build_narrative(hopping))


def test_steady_power_is_steady_and_hops_are_far_from_it():
    assert fit_nominal(build_dataset(lab(23, {})))[0].noise.intra_pulse_power_excess < 5.0
    assert (
        fit_nominal(build_dataset(hopping_lab(23)))[0].noise.intra_pulse_power_excess
        > 2.0 * model_selection.MAX_INTRA_PULSE_POWER_EXCESS
    )


def test_a_droop_that_does_not_follow_the_power_is_still_a_droop():
    """Each power has another share, so the droop predicts the strongest, held out, worse: it is named in doubt."""
    runs = []
    for group, share in (("short", 0.1), ("weak", 0.3), ("middle", 0.16), ("strong", 0.1), ("train", 0.1)):
        terms = {"laser_droop": {"share": share, "time": 0.04, "spread": 1.0}}
        runs += [replace(run, name=f"{group} {run.name}") for run in lab(24, terms, (group,), 3).runs]
    found = diagnose(Measurement(tuple(runs)))
    assert (found.verdict, found.causes) == ("ambiguous", ("laser_droop",))
    assert any("held-out group strong is 1.1 times that of the nominal model" in reason for reason in found.reasons)


def test_no_cause_has_no_other_form():
    problem, base = fit_nominal(build_dataset(lab(25, {}, ("short", "strong"))))
    assert compute_discrepancy_basis(problem, base, (), ()).shape == (len(problem.data.value), 0)


@pytest.mark.slow
def test_what_only_the_runs_held_out_show_is_not_overlooked():
    limit_k = AMBIENT_K + 220.0
    runs = []
    for run in lab(26, {}).runs:
        old = run.signals[TEMPERATURE]
        runs.append(
            replace(run, signals={**run.signals, TEMPERATURE: Signal(0, old.t_s, np.minimum(old.value, limit_k))})
        )
    data = build_dataset(Measurement(tuple(runs)))
    hot = {data.runs[b.run].group for b in data.blocks if b.kind == 0 and data.value[b.part].max() > 219.9}
    assert hot == {data.runs[run].group for run in split_runs(data)[1]} == {"strong"}
    found = diagnose(Measurement(tuple(runs)))
    assert found.verdict != "none"
    assert found.held_out_runs == ()


def test_the_experiment_says_which_pixel_and_no_size_is_said_twice(hopping):
    ask = NextExperiment("description", np.array([[0.0, 0.01, 1.0, 1.0]]), 4, 3, ("force_N",), 9.0, 6.0)
    proposal = build_answer(replace(hopping, next_experiment=ask))["next_experiment"]
    assert (proposal["pixel"], proposal["repeats"]) == (4, 3)
    twice = tuple(CandidateCause("gas_leak", "gas_leak", 1.0, 0.01, None, "", size) for size in ("rate 1", "rate 2"))
    lines = build_narrative(replace(hopping, verdict="none", candidates=twice))
    assert [line for line in lines if "gas_leak" in line] == ["- gas_leak: rate 1"]


def rivals_of(runs, near, far):
    """Propose an experiment for two models that fit one recording equally well."""
    problem, base = fit_nominal(build_dataset(runs))
    fits = []
    for terms in (near, far):
        point, key = ParameterPoint(base.point.base, terms), next(iter(terms))
        free = tuple(discover_terms()[key].free(name) for name in terms[key])
        fits.append(fit(problem, point, free, iterations=1))
    return propose_experiment(problem, *fits, ("the one", "the other"))


def test_an_experiment_is_asked_for_only_where_it_would_tell_and_as_often_as_it_must():
    quiet = lab(27, {}, ("short", "strong"))
    alike = rivals_of(quiet, {"gas_leak": {"rate": 0.1}}, {"gas_leak": {"rate": 0.1001}})
    assert alike is None
    proposal = rivals_of(quiet, {"gas_leak": {"rate": 0.02}}, {"wall_heating": {"resistance": 6.0, "capacity": 0.05}})
    assert proposal.separation >= 12.0
    assert 3 <= proposal.repeats <= 30
    assert f"{proposal.repeats} times" in proposal.description


def test_noise_is_known_as_well_as_its_part_by_which_two_fits_differ():
    problem, base = fit_nominal(build_dataset(lab(21, {}, repeats=2)))
    jitter = compute_jitter_sensitivity(problem.data, base.point, base.prediction)
    certainty = NoiseCertainty(problem, base)
    jitter_degrees = count_noise_degrees(problem.data)
    as_power = replace(base, prediction=base.prediction + 0.3 * jitter.power)
    assert certainty.count_degrees(as_power) == pytest.approx(jitter_degrees, rel=0.3)
    alternating = np.zeros(len(problem.data.value))
    for block in problem.data.blocks:
        alternating[block.part] = problem.noise.coloured[block.kind].white * (-1.0) ** np.arange(len(block.t_s))
    assert certainty.count_degrees(replace(base, prediction=base.prediction + alternating)) == MAX_DEGREES
    assert certainty.count_degrees(base) == jitter_degrees
