"""Power from simulated participants against computations that share no code with it: binomial, mixed and Student's."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, binomtest, nct, norm, t

from optodrive.cli.main import run

sys.path.append(str(Path(__file__).parents[2] / "docs" / "examples"))
from analyse_study import estimate_threshold

TOLERANCE = 0.05
LAPSE, SPREAD = 0.025, 0.35
THRESHOLDS = """
format = "optodrive-study"
version = 2
name = "side"
title = "Side"
seed = 5
pause_s = 0.5

[stimulus]
pattern = "detection"

[factors]
side = ["left", "right"]

[response]
kind = "choice"
question = "On which side?"
answers = ["left", "right"]
correct_factor = "side"
chance_level = 0.5

[procedure]
kind = "constant"
parameter = "power_mw"
levels = [30.0, 45.0, 67.0, 100.0, 150.0, 225.0]
trials = 60

[catch]
trials = 3

[practice]
trials = 3

[simulation]
observer = "detection"
"""


def estimate(capsys, *words):
    assert run(["study", "power", *words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    return report, {one["participants"]: one for one in report["powers"]}


def compute_binomial_power(share, trials, reference):
    """Return how often Clopper and Pearson's interval of all answers excludes a reference."""
    counts = np.arange(trials + 1)
    ends = [binomtest(int(k), trials).proportion_ci(0.95, "exact") for k in counts]
    excludes = np.array([end.low > reference or end.high < reference for end in ends])
    return float(binom.pmf(counts, trials, share)[excludes].sum())


@pytest.mark.parametrize(("reference", "seeds"), [(0.93, 2500), pytest.param(0.95, 20_000, marks=pytest.mark.slow)])
def test_alike_participants_have_the_power_of_the_binomial_distribution(capsys, reference, seeds):
    words = ["experiment-6", "--participants", "2..12", "--reference", str(reference), "--seeds", str(seeds)]
    report, powers = estimate(capsys, *words)
    share = 1.0 - LAPSE + LAPSE / 6.0  # fingers are not confused
    assert report["mean"] == pytest.approx(share, abs=0.002)
    expected = {number: compute_binomial_power(share, 30 * number, reference) for number in powers}
    assert {number: one["power"] for number, one in powers.items()} == pytest.approx(expected, abs=TOLERANCE)
    assert max(expected.values()) - min(expected.values()) > 0.4
    enough = next((number for number, one in powers.items() if one["power"] >= 0.8), None)
    assert report["enough_participants"] == enough


def simulate_localisation(number, reference, studies=20_000):
    """Return how often Student's interval excludes a reference, where participants differ in their sense of place.

    A target on a corner of 3 x 3 places is missed towards two sides, one on an edge towards three.
    """
    rng = np.random.default_rng(1)
    acuity = np.exp(SPREAD * rng.standard_normal((studies, number)))
    half = 0.5 * 3.6e-3 / (1.35e-3 / acuity * np.sqrt(0.5 / 0.575))
    inner, outer = 2.0 * norm.cdf(half) - 1.0, norm.cdf(half)
    correct = np.zeros((studies, number))
    for places, share in ((4, outer**2), (4, outer * inner), (1, inner**2)):
        correct += rng.binomial(5 * places, (1.0 - LAPSE) * share + LAPSE / 9.0)
    shares = correct / 45.0
    half_width = t.ppf(0.975, number - 1) * shares.std(axis=1, ddof=1) / np.sqrt(number)
    return float((np.abs(shares.mean(axis=1) - reference) > half_width).mean())


def test_participants_who_differ_have_the_power_of_a_mixed_model(capsys):
    words = ["experiment-3", "--participants", "4..16", "--reference", "0.65"]
    report, powers = estimate(capsys, *words, "--spread", str(SPREAD), "--seeds", "2000")
    assert report["test"] == "Student's interval over participants"
    expected = {number: simulate_localisation(number, 0.65) for number in powers}
    assert {number: one["power"] for number, one in powers.items()} == pytest.approx(expected, abs=TOLERANCE)
    assert expected[16] - expected[4] > 0.3


def test_thresholds_have_the_power_of_students_interval(capsys, tmp_path):
    (tmp_path / "side.toml").write_text(THRESHOLDS)
    report, powers = estimate(
        capsys, str(tmp_path / "side.toml"), "--participants", "4..12", "--reference", "120", "--seeds", "150"
    )
    # Spread of one participant from the median interval of the largest study.
    largest = powers[12]
    half = 0.5 * (largest["effect_high"] - largest["effect_low"])
    deviation = half / t.ppf(0.975, 11) * np.sqrt(12)
    for number, one in powers.items():
        shift = (report["mean"] - np.log(120.0)) / deviation * np.sqrt(number)
        critical = t.ppf(0.975, number - 1)
        expected = nct.sf(critical, number - 1, shift) + nct.cdf(-critical, number - 1, shift)
        assert one["power"] == pytest.approx(expected, abs=2 * TOLERANCE)


def simulate_gaps(people, spread, seed=3):
    """Return shares of correct answers by gap [n, 5], and logarithms of thresholds [n], by the closed form."""
    rng, gaps = np.random.default_rng(seed), np.array([5.0, 10.0, 20.0, 40.0, 80.0])
    acuity = np.exp(spread * rng.standard_normal(people))
    share = 0.5 * LAPSE + (1.0 - LAPSE) * norm.cdf(gaps * acuity[:, None] / (10.0 * np.sqrt(2.0)))
    counts = rng.binomial(10, share)
    slopes, found = np.geomspace(0.75, 3.0, 7), []
    for one in counts:
        answers = np.concatenate([np.arange(10) < count for count in one])
        threshold = estimate_threshold(gaps, 0.5, slopes, np.repeat(gaps, 10), answers)["threshold"]
        found.append(np.log(threshold) if 5.0 <= threshold <= 80.0 else np.nan)
    return counts / 10.0, np.array(found)


def compute_student_power(values, number, reference, studies=20_000):
    drawn = np.random.default_rng(4).choice(values, size=(studies, number))
    half = t.ppf(0.975, number - 1) * drawn.std(axis=1, ddof=1) / np.sqrt(number)
    return float((np.abs(drawn.mean(axis=1) - reference) > half).mean())


@pytest.mark.slow
@pytest.mark.parametrize("reference", [8.0, 16.0])
def test_thresholds_of_a_design_with_levels_have_the_power_of_other_code(capsys, reference):
    words = ["gap-detection", "--participants", "4..40", "--spread", str(SPREAD), "--seeds", "3000"]
    report, powers = estimate(capsys, *words, "--reference", str(reference))
    assert report["effect"] == "logarithm of gap_ms"
    _, thresholds = simulate_gaps(3000, SPREAD)
    known = thresholds[np.isfinite(thresholds)]
    assert report["simulated_participants_with_a_value"] / 3000 == pytest.approx(len(known) / 3000, abs=0.03)
    expected = {number: compute_student_power(known, number, np.log(reference)) for number in powers}
    assert {number: one["power"] for number, one in powers.items()} == pytest.approx(expected, abs=TOLERANCE)
    assert expected[40] - expected[4] > 0.4


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [600, 5000])
def test_shares_of_a_design_with_levels_have_the_power_of_a_mixed_model(capsys, seeds):
    words = ["gap-detection", "--participants", "4..40", "--spread", str(SPREAD), "--seeds", str(seeds)]
    _, powers = estimate(capsys, *words, "--compare", "gap_ms", "--reference", "0.32")
    shares, _ = simulate_gaps(5000, SPREAD)
    differences = shares[:, -1] - shares[:, 0]
    expected = {number: compute_student_power(differences, number, 0.32) for number in powers}
    tolerance = TOLERANCE if seeds == 5000 else 2.0 * TOLERANCE  # the spread of 600 simulated participants
    assert {number: one["power"] for number, one in powers.items()} == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["detection"], "--reference: missing, expected a value of power_mw"),
        (["detection", "--reference", "-3"], "--reference: got -3"),
        (["gap-detection", "--reference", "0.7"], "--reference: got 0.7, expected a value of gap_ms, 5 to 80,"),
        (["experiment-4"], "--compare: missing, expected one of level"),
        (["experiment-2", "--compare", "spede"], "--compare: got 'spede', expected one of direction, speed"),
        (["experiment-1", "--participants", "1..5"], "--participants: got '1..5'"),
        (["experiment-1", "--participants", "9..5"], "--participants: got '9..5'"),
        (["experiment-1", "--seeds", "3"], "--seeds: got 3"),
        (["experiment-1", "--reference", "1.5"], "--reference: got 1.5"),
        (["equalisation"], "study: got 'equalisation'"),
    ],
)
def test_what_the_design_has_not_is_refused_in_one_line(capsys, words, says):
    assert run(["study", "power", *words]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


def test_two_levels_of_a_factor_are_compared(capsys):
    report, powers = estimate(capsys, "experiment-4", "--compare", "level", "--participants", "4", "--seeds", "40")
    assert report["effect"] == "logarithm of the answers, level 9 less 1"
    assert report["mean"] > 1.0
    assert powers[4]["power"] > 0.9
