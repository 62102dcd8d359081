"""OpenAPI document and daemon, compared by schemathesis: no status 5xx and no undocumented response."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from rig import TOKEN

SCHEMATHESIS = Path(sys.executable).with_name("schemathesis")
BOUNDS = 'lease_s = 1.0\n[daemon]\nrequests_per_s = 1e5\nrequests_burst = 100000\naudit = "{}/audit.jsonl"\n#'
TELEMETRY = "/v1/telemetry"
"""This route has no end, so each case lasts until its timeout."""
DIM = "/v1/dim"
"""Without this route, pulses are executed while the others are tried."""
KEEPS_ARMED = [part for path in ("arm", "disarm", "stop") for part in ("--exclude-path", f"/v1/{path}")]
# What a display can show is more than a schema can say: 422 for what one allows is an answer, and documented.
CHECKS = ["--checks", "all", "--exclude-checks", "positive_data_acceptance"]


def schemathesis(daemon, *arguments, examples):
    done = subprocess.run(
        [
            SCHEMATHESIS,
            "run",
            f"{daemon.url}/openapi.json",
            *("--header", f"Authorization: Bearer {TOKEN}"),
            *("--max-examples", str(examples), "--seed", "1", "--request-timeout", "60"),
            *("--no-shrink", "--generation-database", "none"),
            *CHECKS,
            *arguments,
        ],
        capture_output=True,
        text=True,
        cwd=daemon.config.parent,
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert "Traceback" not in daemon.errors.read_text()
    return done.stdout


@pytest.fixture
def open_daemon(make_daemon, board, tmp_path):
    return make_daemon(board, replace=[("lease_s = 1.0", BOUNDS.format(tmp_path))])


@pytest.mark.slow
def test_the_document(open_daemon):
    said = schemathesis(open_daemon, "--exclude-path", TELEMETRY, examples=10)
    paths = open_daemon.call("GET", "/openapi.json")["paths"]
    total = sum(map(len, paths.values()))
    assert f"{total - 1} selected / {total} total" in said


@pytest.mark.slow
def test_the_routes_that_disarm_are_as_documented(open_daemon):
    only = [word.replace("exclude", "include") for word in KEEPS_ARMED]
    assert "3 selected" in schemathesis(open_daemon, *only, "--phases", "coverage,fuzzing", examples=5)


@pytest.mark.slow
def test_telemetry_is_as_documented(open_daemon):
    only = ("--include-path", TELEMETRY, "--request-timeout", "0.5", "--phases", "coverage,fuzzing")
    assert "1 selected" in schemathesis(open_daemon, *only, examples=2)


@pytest.mark.parametrize(
    "phases", ["examples,fuzzing", pytest.param("examples,coverage,fuzzing,stateful", marks=pytest.mark.slow)]
)
def test_the_document_while_armed(open_daemon, phases):
    open_daemon.arm()
    excluded = [*KEEPS_ARMED, "--exclude-path", TELEMETRY, "--exclude-path", DIM]
    schemathesis(open_daemon, *excluded, "--phases", phases, examples=3)
    assert open_daemon.state()["totals"]["executed"] > 0


@pytest.mark.slow
@pytest.mark.timeout(1800)  # thousands of requests: a busy computer needs longer than the limit of a test that hangs
def test_the_document_for_longer(open_daemon):
    schemathesis(open_daemon, "--exclude-path", TELEMETRY, examples=100)


@pytest.mark.slow
def test_a_wrong_document_is_detected(open_daemon):
    """Mutant: the document without a status that the daemon returns."""
    document = open_daemon.call("GET", "/openapi.json")
    del document["paths"]["/v1/plans/{plan_id}"]["get"]["responses"]["404"]
    path = open_daemon.config.parent / "lies.json"
    path.write_text(json.dumps(document))
    done = subprocess.run(
        [
            *(SCHEMATHESIS, "run", path, "--url", open_daemon.url, "--header", f"Authorization: Bearer {TOKEN}"),
            *("--include-path", "/v1/plans/{plan_id}", "--include-method", "GET", "--max-examples", "3", "--no-shrink"),
            *("--phases", "coverage"),
        ],
        capture_output=True,
        text=True,
        cwd=path.parent,
    )
    assert done.returncode == 1, done.stdout
    assert "[404] Not Found" in done.stdout
