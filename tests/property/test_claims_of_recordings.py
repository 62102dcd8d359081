"""No answer to a random recording claims what its own residuals do not show, and its text says what its JSON says.

Recordings, hidden causes and faults of instruments come from `tests/blind`, and the judge recomputes gains and errors
by itself: neither shares code with the diagnosis. The gate diagnoses a few recordings, the slow tests a thousand.
"""

import tempfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from blind_causes import CATALOGUE
from blind_faults import measure_scales
from blind_instruments import NINE, draw_faults, draw_hidden, record
from claim_judge import STATIC_TEXTS, list_faults, list_faults_of_claim, list_faults_of_text
from optodrive.core.errors import OptodriveError
from optodrive.core.types.measurements import Measurement
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.narrative import build_answer, build_narrative
from optodrive.lab.diagnosis.nominal_fit import build_prior
from optodrive.lab.recording import read_recording

FAULTS_MAX, GROUPS_MAX, REPEATS_MAX = 4, 5, 3
SHORT_SHARE = 0.75
"""Share of the recordings that keep a few single pulses alone, which are diagnosed in a third of the time."""
PIECES, PIECE = 40, 25
"""Pieces of 1,000 recordings: one takes some 12 minutes of processor time, 30 s for a recording."""
NAMED, NOTHING = 1, 4
"""Clean recordings with a cause that is named, and without one."""
OUTLIER_SIGMA, SAMPLES_PER_OUTLIER, INTERVAL_CHANGE_MAX = 25.0, 10_000, 0.05


def shorten(case):
    """Keep up to five experiments with single pulses on the measured pixel, each with two or three repeats."""
    groups = {}
    for run in case.runs:
        pulses, experiment = run.experiment.pulses, run.experiment
        if experiment.commands is None and len(pulses) == 1 and pulses[0, 3] == experiment.pixel == 0:
            groups.setdefault(experiment.name, []).append(run.name)
    repeated = [names[:REPEATS_MAX] for names in groups.values() if len(names) > 1][:GROUPS_MAX]
    case.runs = [run for run in case.runs if any(run.name in names for names in repeated)]


def draw_recording(number, folder):
    """Draw one of the random recordings: a cause or none, and zero to four faults of instruments."""
    rng = np.random.default_rng([number, 6061])
    count = int(rng.integers(FAULTS_MAX + 1))
    kind = f"mixed{count}" if count else "nothing"
    cause = "none" if rng.random() < 1 / 3 else str(rng.choice(list(CATALOGUE)))
    case = draw_hidden(kind, number, cause, folder)
    if rng.random() < SHORT_SHARE:
        shorten(case)
    return read_recording(record(case, draw_faults(kind, number, case), folder / "recording.h5"))


def answer(measurement):
    prior, _ = build_prior(measurement, None)
    return diagnose(measurement, 0, prior)


def check(number):
    """Check the answer to a random recording. Bad input may be refused in one line; any other error is a traceback."""
    with tempfile.TemporaryDirectory() as folder:
        measurement = draw_recording(number, Path(folder))
    with suppress(OptodriveError):
        assert not list_faults(answer(measurement), measurement)


@pytest.mark.parametrize("number", [9001, 9002])
def test_no_answer_claims_more_than_its_residuals_show(number):
    check(number)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("piece", range(PIECES))
def test_no_answer_to_a_thousand_recordings_claims_more_than_its_residuals_show(piece):
    for number in range(PIECE * piece, PIECE * (piece + 1)):
        try:
            check(number)
        except BaseException as error:
            error.add_note(f"recording {number}")
            raise


# --- clean recordings -----------------------------------------------------------------------------------------------


def draw_clean(number, folder):
    """Return a short recording without faults, with one of nine causes or none, and the noise of its signals."""
    cause = NINE[number % len(NINE)] if number % 4 else "none"
    case = draw_hidden("nothing", number, cause, folder)
    shorten(case)
    return read_recording(record(case, (), folder / "recording.h5")), measure_scales(case).white


@pytest.fixture(scope="module")
def named(tmp_path_factory):
    """A clean recording in which a cause is named, and its answer."""
    measurement, _ = draw_clean(NAMED, tmp_path_factory.mktemp("named"))
    found = answer(measurement)
    assert found.verdict == "cause"
    assert not list_faults(found, measurement)
    return found, measurement


def swap_models(traces):
    """Mutant: the extension makes each signal as much worse as it made it better."""
    return tuple(replace(trace, nominal=trace.extended, extended=trace.nominal) for trace in traces)


def explain_little(traces):
    """Mutant: the extension explains a third of the excess."""
    share = 1.0 - (2.0 / 3.0) ** 0.5
    mixed = [(trace, trace.nominal + share * (trace.extended - trace.nominal)) for trace in traces]
    return tuple(replace(trace, extended=extended) for trace, extended in mixed)


def test_a_claim_that_makes_held_out_signals_worse_is_caught(named):
    found, measurement = named
    worse = replace(found, held_out_traces=swap_models(found.held_out_traces))
    assert any("worse by" in fault for fault in list_faults_of_claim(worse, measurement))


def test_a_claim_that_explains_less_than_half_is_caught(named):
    found, measurement = named
    little = replace(found, residual_traces=explain_little(found.residual_traces))
    assert any("explains" in fault for fault in list_faults_of_claim(little, measurement))


@pytest.mark.parametrize("start", ["Probabilities:", "This explains", "Heights planned", "Visible in", "  "])
def test_a_number_of_the_text_that_is_not_in_the_json_is_caught(named, start):
    found, _ = named
    lines, document = build_narrative(found), build_answer(found)
    line = next(line for line in lines if line.startswith(start) and any(map(str.isdigit, line)))
    changed = "".join(str((int(c) + 3) % 10) if c.isascii() and c.isdigit() else c for c in line)
    assert list_faults_of_text([changed], document, STATIC_TEXTS)


def add_outliers(measurement, white, rng):
    """Return a recording with one sample in 10,000 off by 25 σ, one at least."""
    traces = [(run.name, name) for run in measurement.runs for name in run.signals if name in white]
    values = {(run.name, name): run.signals[name].value.copy() for run in measurement.runs for name in run.signals}
    places = [(key, k) for key in traces for k in np.flatnonzero(np.isfinite(values[key])).tolist()]
    for place in rng.choice(len(places), max(1, len(places) // SAMPLES_PER_OUTLIER), replace=False).tolist():
        key, k = places[place]
        values[key][k] += float(rng.choice([-1.0, 1.0])) * OUTLIER_SIGMA * white[key[1]]
    return Measurement(
        tuple(
            replace(run, signals={n: replace(s, value=values[run.name, n]) for n, s in run.signals.items()})
            for run in measurement.runs
        )
    )


def list_changes(before, after):
    """Return what differs between two answers: verdict, causes, and intervals by more than a share of their width."""
    changes = [name for name in ("verdict", "causes") if getattr(before, name) != getattr(after, name)]
    for name in before.parameters.keys() & after.parameters.keys() if not changes else ():
        old, new = before.parameters[name], after.parameters[name]
        width = old.high - old.low
        if old.at_limit or new.at_limit or not width:
            changes += [] if old.at_limit == new.at_limit else [f"{name} at its limit"]
            continue
        wider = abs((new.high - new.low) / width - 1.0)
        moved = abs(0.5 * (new.high + new.low) - 0.5 * (old.high + old.low)) / width
        if max(wider, moved) > INTERVAL_CHANGE_MAX:
            changes.append(f"{name}: width by {wider:.1%}, centre by {moved:.1%} of it")
    return changes


def compare_with_outliers(number, folder, found=None):
    measurement, white = draw_clean(number, folder)
    disturbed = add_outliers(measurement, white, np.random.default_rng([number, 77]))
    return list_changes(found or answer(measurement), answer(disturbed))


def test_an_outlier_changes_no_verdict_and_no_interval(tmp_path, named):
    assert not compare_with_outliers(NAMED, tmp_path, named[0])
    assert not compare_with_outliers(NOTHING, tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("number", range(100, 112))
def test_outliers_change_no_verdict_and_no_interval_of_drawn_recordings(tmp_path, number):
    assert not compare_with_outliers(number, tmp_path)
