"""Effects hidden by the generator are found through the library.

Every run diagnoses a fixed case with nothing hidden and one with a cause; the slow tests draw cases of each block that
change with the printed seed. BLIND_SEED=n replays a failure of these. Their thresholds are such that random failures
are rare; `scripts/bench blind` measures rates.
"""

import os
import secrets
from typing import NamedTuple

import pytest

from blind_lab import draw_case
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.narrative import build_answer
from optodrive.lab.diagnosis.nominal_fit import build_prior
from optodrive.lab.recording import read_recording


class Draw(NamedTuple):
    """A seed, the rows of cases of each block, and how many answers may be wrong."""

    seed: int
    rows: dict[str, range]
    false_alarms_max: int
    missed_max: int
    misnamed_max: int
    unknown_named_max: int


FIXED = Draw(2_500_000, {"none": range(1, 2), "single": range(1, 2)}, 0, 0, 0, 0)
DRAWN = Draw(
    int(os.environ.get("BLIND_SEED") or secrets.randbelow(1_000_000) + 2_000_000),
    {"none": range(2), "single": range(4), "pair": range(1), "unknown": range(2)},
    1,
    2,
    1,
    1,
)
pytestmark = pytest.mark.timeout(600)  # all cases are drawn and diagnosed before the first of them


def found(case):
    measurement = read_recording(case.path)
    prior, _ = build_prior(measurement, None)
    return build_answer(diagnose(measurement, 0, prior))


BOTH = pytest.mark.parametrize(
    "drawn", [FIXED, pytest.param(DRAWN, marks=pytest.mark.slow)], ids=["fixed", "drawn"], scope="module"
)
ONLY_DRAWN = pytest.mark.parametrize(
    "drawn", [pytest.param(DRAWN, marks=pytest.mark.slow)], ids=["drawn"], scope="module"
)


@pytest.fixture(scope="module")
def answers(drawn, tmp_path_factory):
    """(case, answer) of every block."""
    print(f"BLIND_SEED={drawn.seed}")
    results = {}
    for block, rows in drawn.rows.items():
        cases = [draw_case(block, drawn.seed + row, tmp_path_factory.mktemp(block)) for row in rows]
        results[block] = [(case, found(case)) for case in cases]
    return results


def what(drawn, results):
    return f"BLIND_SEED={drawn.seed}: " + "; ".join(
        f"{case.causes} → {item['verdict']} {item['causes']}" for case, item in results
    )


@BOTH
def test_nothing_hidden_is_mostly_left_alone(drawn, answers):
    alarms = sum(item["verdict"] != "none" for _, item in answers["none"])
    assert alarms <= drawn.false_alarms_max, what(drawn, answers["none"])


@BOTH
def test_most_single_causes_are_found_and_hardly_one_is_misnamed(drawn, answers):
    results = [(case, item) for case, item in answers["single"] if "sensor_scale" not in case.causes]
    right = sum(set(case.causes) <= set(item["causes"]) for case, item in results)
    wrong = sum(item["verdict"] == "cause" and set(item["causes"]) != set(case.causes) for case, item in results)
    assert right >= len(results) - drawn.missed_max, what(drawn, results)
    assert wrong <= drawn.misnamed_max, what(drawn, results)


@ONLY_DRAWN
def test_what_is_in_no_catalogue_is_not_all_named(drawn, answers):
    named = sum(item["verdict"] == "cause" for _, item in answers["unknown"])
    assert named <= drawn.unknown_named_max, what(drawn, answers["unknown"])


@ONLY_DRAWN
def test_of_two_causes_no_two_are_false(drawn, answers):
    for case, item in answers["pair"]:
        assert not item["causes"] or set(item["causes"]) & set(case.causes), what(drawn, answers["pair"])
