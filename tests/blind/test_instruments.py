"""Faults of instruments take no cause in the pixel for a reason, and no hidden cause loses its name to them.

The gate draws every kind of fault, judges answers of all sorts, and diagnoses a few recordings. The slow tests measure
rates on the judging seeds, one kind in each test: the aims are those of `blind_verdicts.py`.
"""

from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from blind_display import DISPLACEMENT, TEMPERATURE
from blind_faults import FAULTS, STAMPS, Fault, measure_scales
from blind_instruments import KINDS, MIXED, NINE, choose_cause, draw_faults, draw_hidden, record, run_case
from blind_lab import draw_case
from blind_verdicts import ALLOWED, Said, judge

JUDGING = range(100, 120)
"""Seeds of the slow tests; nobody looks at their cases one by one."""
RIGHT_MIN, WRONG_MAX, NULL_CAUSES_MAX, NULL_ACCUSED_MAX = 0.85, 0.01, 0.01, 0.03
PIECE_S = 1200


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return draw_case("none", 4, tmp_path_factory.mktemp("case"))


def read(path):
    """Return (times, values) of every signal of every run, and the start times."""
    with h5py.File(path) as file:
        traces = {
            (run, name): (group[name]["t_s"][()], group[name]["value"][()])
            for run, group in file["runs"].items()
            for name in group
            if isinstance(group[name], h5py.Group)
        }
        return traces, {run: group.attrs["started_at"] for run, group in file["runs"].items()}


@pytest.fixture(scope="module")
def clean(case, tmp_path_factory):
    return read(record(case, (), tmp_path_factory.mktemp("clean") / "recording.h5"))


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_touches_its_signals_and_runs_and_nothing_else(case, clean, tmp_path, kind):
    for seed in range(2):
        faults = draw_faults(kind, seed, case)
        traces, stamps = read(record(case, faults, tmp_path / f"{seed}.h5"))
        assert traces.keys() == clean[0].keys()
        touched = {
            (run.name, name) for run in case.runs for name in run.shown if any(f.touches(run, name) for f in faults)
        }
        changed = {
            key
            for key, (t_s, value) in traces.items()
            if len(t_s) != len(clean[0][key][0])
            or not np.array_equal(t_s, clean[0][key][0])
            or not np.array_equal(value, clean[0][key][1], equal_nan=True)
        }
        assert changed <= touched
        assert (stamps != clean[1]) == (kind == "stamps")
        assert changed or kind == "stamps"
        for t_s, _ in traces.values():
            assert np.all(np.diff(t_s) > 0)


def test_a_case_is_the_same_each_time(case, tmp_path):
    kind = "+".join(FAULTS)
    both = [read(record(case, draw_faults(kind, 3, case), tmp_path / f"{k}.h5")) for k in range(2)]
    assert both[0][1] == both[1][1]
    for key, (t_s, value) in both[0][0].items():
        assert np.array_equal(t_s, both[1][0][key][0])
        assert np.array_equal(value, both[1][0][key][1], equal_nan=True)


def test_mixed_kinds_hold_one_to_four_faults(case):
    for count, kind in enumerate(MIXED, start=1):
        drawn = [tuple(f.kind for f in draw_faults(kind, seed, case)) for seed in range(5)]
        assert all(len(set(kinds)) == count for kinds in drawn)
        assert len(set(drawn)) > 2


def test_faults_have_their_size(case, tmp_path):
    scales = measure_scales(case)
    for seed in range(4):
        for kind in ("ceiling", "signal_clock", "quantised"):
            (fault,) = draw_faults(kind, seed, case)
            traces, _ = read(record(case, (fault,), tmp_path / "recording.h5"))
            name = fault.signals[0]
            values = np.concatenate([value[np.isfinite(value)] for (_, n), (_, value) in traces.items() if n == name])
            if kind == "quantised":
                step = fault.sizes["sigma"] * scales.white[name]
                assert np.abs(values / step - np.round(values / step)).max() < 1e-6
            if kind == "ceiling" and fault.form == "converter":
                assert (fault.sizes["side"] * (values - fault.sizes["at"])).max() <= 1e-9


def test_start_times_are_written_in_every_form(case):
    scales = measure_scales(case)
    forms = {FAULTS["stamps"](np.random.default_rng(seed), scales).form for seed in range(120)}
    assert forms == set(STAMPS)


def test_every_kind_states_what_is_allowed():
    assert ALLOWED.keys() == FAULTS.keys()
    assert {choose_cause("flat", "each", seed) for seed in range(9)} == set(NINE)


def test_a_weak_cause_is_hidden(tmp_path):
    hidden = draw_hidden("weak", 0, "weak", tmp_path)
    assert hidden.causes == ("laser_droop",)
    assert hidden.truth.droop[0] == pytest.approx(hidden.sizes["depth"])


RUN = "r003-ladder"
ANSWERS = [
    # fault, its words, hidden, verdict, causes, text of the answer → mark
    ("flat", (), "none", [], f"{RUN}: displacement_m is flat", "right"),
    ("flat", (), "none", [], "", "allowed"),
    ("flat", (), "cause", ["clock_offset"], f"{RUN}: displacement_m is flat", "wrong"),
    ("flat", ("gas_leak",), "cause", ["gas_leak"], f"{RUN}: displacement_m is flat", "right"),
    ("flat", ("gas_leak",), "cause", ["gas_leak"], f"r004-ladder: {TEMPERATURE} is flat", "allowed"),
    ("flat", ("gas_leak",), "none", [], f"{RUN}: displacement_m is flat", "allowed"),
    ("ceiling", (), "cause", ["membrane_stiffening"], "", "wrong"),
    ("ceiling", (), "ambiguous", ["membrane_stiffening", "gas_leak"], "", "missed"),
    ("ceiling", (), "unexplained", [], "displacement_m is clipped", "allowed"),
    ("ceiling", (), "unexplained", [], "", "missed"),
    ("time_rate", (), "cause", ["time_rate"], "", "right"),
    ("time_rate", (), "cause", ["clock_offset"], "", "allowed"),
    ("time_rate", (), "cause", ["laser_lag", "sensor_lag"], "", "wrong"),
    ("time_rate", ("gas_leak",), "cause", ["gas_leak", "time_rate"], "", "right"),
    ("time_rate", ("gas_leak",), "cause", ["time_rate"], "", "allowed"),
    ("time_rate", (), "none", [], "", "allowed"),
    ("high_pass", (), "ambiguous", ["gas_leak", "high_pass"], "", "right"),
    ("high_pass", (), "cause", ["gas_leak"], "", "wrong"),
    ("high_pass", (), "ambiguous", ["gas_leak"], "", "missed"),
    ("high_pass", ("radiation",), "ambiguous", ["gas_leak", "high_pass"], "", "allowed"),
    ("high_pass", ("gas_leak",), "cause", ["gas_leak"], "", "right"),
    ("quantised", (), "none", [], "", "right"),
    ("quantised", (), "undecided", [], "", "allowed"),
    ("quantised", (), "cause", ["ambient_drift"], "", "wrong"),
    ("quantised", (), "unexplained", [], "", "missed"),
    ("quantised", ("gas_leak",), "ambiguous", ["gas_leak", "radiation"], "", "right"),
    ("quantised", ("gas_leak",), "ambiguous", ["gas_leak", "radiation", "heat_capacity", "laser_droop"], "", "allowed"),
    ("quantised", ("gas_leak",), "ambiguous", ["radiation", "heat_capacity"], "", "missed"),
    ("quantised", ("gas_leak",), "cause", ["gas_leak", "radiation"], "", "wrong"),
    ("quantised", ("gas_leak",), "perhaps", [], "", "allowed"),
]


@pytest.mark.parametrize(("kind", "hidden", "verdict", "causes", "text", "mark"), ANSWERS)
def test_answers_are_marked_as_the_table_says(kind, hidden, verdict, causes, text, mark):
    fault = Fault(kind, "", (DISPLACEMENT,), (RUN,) if kind == "flat" else ())
    hidden_case = SimpleNamespace(causes=hidden)
    answer = {"verdict": verdict, "causes": causes, "remarks": [text] if text else []}
    outcome = judge(hidden_case, (fault,), Said(answer, ""))
    assert outcome.mark == mark, outcome.why
    assert outcome.accuses_pixel == (
        verdict == "unexplained" or bool(set(causes) - {"time_rate", "clock_offset", "ambient_drift", "high_pass"})
    )


@pytest.mark.parametrize(
    ("kind", "message", "mark"),
    [
        ("sentinel", f"optodrive: r.h5: /runs/{RUN}/{DISPLACEMENT}/value[3]: -9999.0, expected at most 0.01", "right"),
        ("sentinel", "optodrive: r.h5: a value is impossible", "missed"),
        ("sentinel", f"optodrive: r.h5: {DISPLACEMENT}\nsecond line", "missed"),
        (
            "exchanged",
            "optodrive: recording: r/pulses: width_s: got times that do not suit, it is likely in ms",
            "missed",
        ),
        ("coloured", f"optodrive: r.h5: {DISPLACEMENT}: too noisy", "missed"),
        ("coloured", "Traceback (most recent call last):\nKeyError: 'x'", "wrong"),
        ("coloured", "Killed", "wrong"),
    ],
)
def test_refusals_name_a_place_and_tracebacks_are_wrong(kind, message, mark):
    outcome = judge(SimpleNamespace(causes=()), (Fault(kind, "", (DISPLACEMENT,)),), Said({}, message))
    assert outcome.mark == mark, outcome.why


def test_nothing_found_with_false_heights_is_wrong(tmp_path):
    case = draw_case("single", 2, tmp_path, cause="membrane_stiffening")
    parameters = {name: {"value": case.base[name], "ci95": None} for name in ("R", "C", "tau_g", "kappa")}
    answer = {"verdict": "none", "causes": [], "parameters": parameters}
    outcome = judge(case, (), Said(answer, ""))
    assert outcome.mark == "wrong", outcome
    assert outcome.heights[0] > 0.02
    stated = {"held_out": {"nominal_rms": 1.0, "extended_rms": 1.0, "noise": 0.01}, "fitted": None}
    assert judge(case, (), Said(answer | {"height_error": stated}, "")).mark == "allowed"


GATE = [("nothing", 0, "none"), ("flat", 1, "none"), ("sign", 1, "none"), ("hold", 1, "none")]


@pytest.mark.timeout(300)
@pytest.mark.parametrize(("kind", "seed", "cause"), GATE)
def test_a_fault_is_judged_truthfully(kind, seed, cause):
    row = run_case(kind, seed, cause)
    assert row["outcome"] == "right", row


@pytest.mark.slow
@pytest.mark.timeout(PIECE_S)
@pytest.mark.parametrize("kind", [*KINDS[:-1], *MIXED])
def test_beside_nothing_no_pixel_is_accused(kind):
    rows = [run_case(kind, seed, "none", quick=True) for seed in JUDGING]
    said = [f"{row['seed']}: {row['verdict']} {row['causes']}: {row['why']}" for row in rows]
    assert not any(row["outcome"] == "wrong" for row in rows), said
    assert sum(bool(set(row["causes"])) and row["accuses_pixel"] for row in rows) <= NULL_ACCUSED_MAX * len(rows), said
    if kind in ("nothing", "quantised", "coloured", "free_running", "stamps", "slow_drift", "outliers", "flat"):
        assert sum(row["verdict"] == "cause" for row in rows) <= NULL_CAUSES_MAX * len(rows), said


@pytest.mark.slow
@pytest.mark.timeout(PIECE_S)
@pytest.mark.parametrize("kind", [*KINDS, *MIXED])
def test_beside_a_cause_the_cause_is_named(kind):
    causes = {seed: "weak" if kind == "weak" else choose_cause(kind, "each", seed) for seed in JUDGING}
    rows = [run_case(kind, seed, causes[seed], quick=True) for seed in JUDGING]
    said = [f"{row['seed']} {row['cause']}: {row['verdict']} {row['causes']}: {row['why']}" for row in rows]
    assert sum(row["outcome"] == "wrong" for row in rows) <= WRONG_MAX * len(rows), said
    assert sum(row["keeps_verdict"] for row in rows) >= RIGHT_MIN * len(rows), said
