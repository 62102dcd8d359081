"""Effects hidden by the generator are found through the library; the cases change with the printed seed.

BLIND_SEED=n replays a failure. Thresholds are such that random failures are rare; `scripts/bench blind` measures rates.
"""

import os
import secrets

import pytest

from blind_lab import draw_case
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.narrative import build_answer
from optodrive.lab.diagnosis.priors import build_prior
from optodrive.lab.recording import read_recording

SEED = int(os.environ.get("BLIND_SEED") or secrets.randbelow(1_000_000) + 2_000_000)
NULLS, SINGLES, PAIRS, UNKNOWNS = 2, 4, 1, 2
pytestmark = pytest.mark.timeout(600)  # nine cases are drawn and diagnosed before the first of them


def found(case):
    measurement = read_recording(case.path)
    prior, epsilon, _ = build_prior(measurement, None)
    return build_answer(diagnose(measurement, 0, prior, epsilon))


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """(case, answer) of every block."""
    print(f"BLIND_SEED={SEED}")
    results = {}
    for block, count in (("none", NULLS), ("single", SINGLES), ("pair", PAIRS), ("unknown", UNKNOWNS)):
        cases = [draw_case(block, SEED + row, tmp_path_factory.mktemp(block)) for row in range(count)]
        results[block] = [(case, found(case)) for case in cases]
    return results


def what(results):
    return f"BLIND_SEED={SEED}: " + "; ".join(
        f"{case.causes} → {item['verdict']} {item['causes']}" for case, item in results
    )


def test_nothing_hidden_is_mostly_left_alone(answers):
    alarms = sum(item["verdict"] != "none" for _, item in answers["none"])
    assert alarms < NULLS, what(answers["none"])


def test_most_single_causes_are_found_and_hardly_one_is_misnamed(answers):
    results = [(case, item) for case, item in answers["single"] if "sensor_scale" not in case.causes]
    right = sum(set(case.causes) <= set(item["causes"]) for case, item in results)
    wrong = sum(item["verdict"] == "cause" and set(item["causes"]) != set(case.causes) for case, item in results)
    assert right >= len(results) - 2, what(results)
    assert wrong <= 1, what(results)


def test_what_is_in_no_catalogue_is_not_all_named(answers):
    named = sum(item["verdict"] == "cause" for _, item in answers["unknown"])
    assert named < UNKNOWNS, what(answers["unknown"])


def test_of_two_causes_no_two_are_false(answers):
    for case, item in answers["pair"]:
        assert not item["causes"] or set(item["causes"]) & set(case.causes), what(answers["pair"])
