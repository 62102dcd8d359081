"""Recordings have the strength that was asked for, and the table of the calibration says what its rows say."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import bench_calibration as calibration

from blind_causes import CONFUSABLE, MECHANISMS
from blind_display import Physics, compute_absorption
from blind_session import build_bench, simulate_ideal_rises
from blind_strength import CAUSES, draw_case_of_strength, draw_keys


@pytest.mark.parametrize(("key", "strength"), [("laser_lag", 5.0), ("absorber_ageing", 12.0)])
def test_a_recording_has_the_wanted_strength(tmp_path, key, strength):
    case = draw_case_of_strength("single", strength, 9_800_001, tmp_path, (key,))
    base = Physics(**case.base)
    sigma = build_bench(base, case.instruments, case.runs).sigma(simulate_ideal_rises(base, case.runs, case.truth))
    assert sigma == pytest.approx(strength, rel=0.1)
    assert case.effect_sigma == pytest.approx(sigma)
    assert case.causes == (key,)
    assert case.path.exists()


def test_kinds_hide_what_they_say():
    rng = np.random.default_rng(1)
    assert draw_keys("none", rng) == ()
    for _ in range(50):
        assert set(draw_keys("single", rng)) <= set(CAUSES)
        assert set(draw_keys("unknown", rng)) <= set(MECHANISMS)
        pair = draw_keys("pair", rng)
        assert len(set(pair)) == 2
        assert frozenset(pair) not in CONFUSABLE


@pytest.mark.parametrize(
    ("form", "early", "late"),
    [("linear", 0.98, 0.92), ("by_time", 0.99, 0.95), ("by_run", 0.96, 0.92), ("step", 1.0, 0.9)],
)
def test_absorption_falls_by_dose_time_run_or_at_once(form, early, late):
    p = Physics(ageing=form, ageing_loss=0.1, ageing_dose=10.0, ageing_s=400.0 if form == "by_time" else 100.0)
    p = p.with_(ageing_runs=25.0)
    assert compute_absorption(p, 2.0, 40.0, 10) == pytest.approx(early)
    assert compute_absorption(p, 8.0, 200.0, 20) == pytest.approx(late)


def build_row(seed, kind="single", causes="gas_leak", verdict="cause", named="gas_leak", **others):
    row = dict.fromkeys(calibration.COLUMNS, "") | {"seed": str(seed), "kind": kind, "causes": causes, "sigma": "5.0"}
    row |= {"target_sigma": "5", "verdict": verdict, "named": named, "elapsed_s": "3.0", "forms": "exponential"}
    stated = {"none": "no_effect:0.900 gas_leak:0.100"}.get(verdict, "gas_leak:0.800 no_effect:0.200")
    return row | {"probabilities": stated, "aic": "gas_leak:1.000", "bic": "no_effect:1.000"} | others


def test_the_summary_counts_false_names_alarms_and_true_causes_ruled_out():
    rows = [
        build_row(1),
        build_row(2, causes="sensor_lag", ruled_out="sensor_lag+radiation"),
        build_row(3, verdict="ambiguous", named="gas_leak+radiation"),
        build_row(4, verdict="ambiguous", named="gas_leak+radiation+sensor_lag"),
        build_row(5, kind="none", causes="", verdict="none", named="", target_sigma=""),
        build_row(6, kind="none", causes="", target_sigma=""),
        build_row(7, kind="unknown", causes="hum+unknown", verdict="unexplained", named=""),
        build_row(8, kind="single", causes="", verdict=""),
        build_row(9, kind="instrument", causes="instrument+line", verdict="instrument", named=""),
    ]
    assert [calibration.is_named(row) for row in rows[:4]] == [True, False, True, False]
    assert [calibration.is_false_name(row) for row in rows[:7]] == [False, True, False, False, False, True, False]
    text = calibration.format_summary(rows)
    assert "8 recordings (1 not sampled" in text
    assert "Disturbances of an instrument: found 1/1, 100 % (21 to 100), taken for a cause in the pixel 0/1" in text
    assert "False alarms in nulls: 1/2, 50 %" in text
    assert "False names: 1/5, 20 %" in text
    assert "| 5 | 5/5, 100 % (57 to 100) |" in text
    assert "false name: 2: sensor_lag" in text
    assert "ruled out though true: 2" in text
    assert "ruled out though true: 1" not in text


def test_reliability_tells_stated_from_true_probabilities():
    rows = [build_row(k, causes="gas_leak" if k % 5 else "radiation") for k in range(100)]
    assert "| 0.7 to 0.9 | 100 | 80.0 % | 80/100, 80 % (71 to 87) | yes |" in calibration.format_reliability(rows)
    overconfident = [row | {"causes": "radiation"} for row in rows[:50]] + rows[50:]
    assert "| 0.7 to 0.9 | 100 | 80.0 % | 40/100, 40 % (31 to 50) | no |" in calibration.format_reliability(
        overconfident
    )
    assert calibration.compute_brier(rows, "probabilities") == pytest.approx(
        0.8 * (0.2**2 + 0.2**2) + 0.2 * (0.8**2 + 0.2**2 + 1.0)
    )


def test_the_ideal_observer_agrees_with_simulated_tests():
    rng = np.random.default_rng(3)
    scores = rng.standard_normal(200_000)
    threshold = np.quantile(scores, 0.99)
    assert calibration.compute_ideal_detection({"sigma": "3.0"}) == pytest.approx(
        np.mean(scores + 3.0 > threshold), abs=0.01
    )
    odds = 4.0 * scores + 0.5 * 4.0**2  # of the truth against a rival at 4 σ
    row = {"sigma": "9.0", "rivals": "radiation:2.00 heat_capacity:4.00"}
    assert calibration.compute_ideal_naming(row) == pytest.approx(np.mean(odds > np.log(0.97 / 0.03)), abs=0.01)


def test_every_kind_meets_every_strength_and_other_tables_are_refused(tmp_path):
    tasks = [calibration.build_task("report", k) for k in range(105)]
    assert {(task.kind, task.strength) for task in tasks} == {
        (kind, strength * (10.0 if kind == "instrument" else 1.0))
        for kind in calibration.KINDS
        for strength in calibration.STRENGTHS
    }
    assert len({task.seed for task in tasks}) == 105
    path = tmp_path / "table.csv"
    assert calibration.read_table(path) == []
    calibration.write_table(path, "report", [build_row(6_100_007), build_row(6_100_003)])
    assert [row["seed"] for row in calibration.read_table(path)] == ["6100003", "6100007"]
    with pytest.raises(SystemExit, match="expected dev seeds"):
        next(calibration.measure("dev", 0.0, None, 0, 1, path))
    assert "2 recordings" in "".join(calibration.measure("report", 0.0, None, 0, 1, path))
    path.write_text("seed,kind\n1,none\n")
    with pytest.raises(SystemExit, match="expected a table"):
        calibration.read_table(path)


@pytest.mark.slow
def test_a_call_adds_the_recordings_that_are_missing(tmp_path):
    path = tmp_path / "table.csv"
    calibration.write_table(path, "dev", [build_row(calibration.FIRST_SEEDS["dev"])])
    list(calibration.measure("dev", 5.0, 1, 0, 1, path))
    assert [int(row["seed"]) - calibration.FIRST_SEEDS["dev"] for row in calibration.read_table(path)] == [0, 1]
