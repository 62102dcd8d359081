"""Wrong input over REST and on the command line: one line, the right status and no effect."""

import contextlib
import io
import json
import os
import socket
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

import httpx
import pytest

from forked_process import run_process
from optodrive.cli.main import run
from rig import TOKEN, running

OPTODRIVE = Path(sys.executable).with_name("optodrive")


@pytest.fixture(scope="module")
def armed(tmp_path_factory):
    with running(tmp_path_factory.mktemp("wrong")) as (_, daemon):
        daemon.arm()
        yield daemon


def frame(**changes):
    return {"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"17": 50}, **changes}


def train(**changes):
    return {
        "pixel": 17,
        "start_s": 0.0,
        "duration_s": 0.3,
        "pulse_width_s": 0.02,
        "gap_s": 0.06,
        "power_w": 1.0,
        **changes,
    }


BODIES = {
    "unknown pixel": ({"frames": [frame(target_um={"437": 50})]}, "unknown_pixel"),
    "negative target": ({"frames": [frame(target_um={"17": -5})]}, "bad_target"),
    "NaN target": ('{"frames": [{"show_at_s": 0, "duration_s": 1, "target_um": {"17": NaN}}]}', "bad_target"),
    "target out of reach": ({"frames": [frame(target_um={"17": 5000})]}, "target_unreachable"),
    "overlapping trains": ({"trains": [train(), train(pixel=18, start_s=0.01)]}, "overlapping_trains"),
    "frame in the past": ({"frames": [frame(show_at_s=-1.0)]}, "bad_time"),
    "bad JSON": ('{"frames": [', "bad_json"),
    "unknown key": ({"frames": [frame(target_nm={})]}, "unknown_key"),
    "nothing": ({}, None),
    "blank frames": ({"frames": [frame(target_um={"17": 0}), frame(show_at_s=1.0, target_um={})]}, "raises_nothing"),
    "not an object": ([1, 2], None),
}


def unchanged(daemon):
    state = daemon.state()
    return state["totals"], state["queue"], state["board"]["state"]


@pytest.mark.parametrize("case", BODIES)
def test_bad_bodies_get_a_problem_document(armed, case):
    body, code = BODIES[case]
    before = unchanged(armed)
    content = body if isinstance(body, str) else json.dumps(body)
    response = armed.client.post("/v1/plans", content=content)
    assert 400 <= response.status_code < 500
    assert response.headers["content-type"] == "application/problem+json"
    problem = response.json()
    assert problem["status"] == response.status_code
    assert "\n" not in problem["detail"]
    if code:
        assert problem["code"] == code
    assert unchanged(armed) == before


def assert_one_line(arguments, naming, environment=None):
    """Run a command in this process, to save its start. The daemon and its clients run in their own processes."""
    if arguments[0] == "serve" or "--url" in arguments:
        command = [OPTODRIVE, *arguments]
        done = run_process(command, capture_output=True, text=True, env={**os.environ, **environment})
        status, output, errors = done.returncode, done.stdout, done.stderr
    else:
        out, err = io.StringIO(), io.StringIO()
        with patch.dict(os.environ, environment or {}), redirect_stdout(out), redirect_stderr(err):
            status = run([str(argument) for argument in arguments])
        output, errors = out.getvalue(), err.getvalue()
    assert status == 2, errors
    assert output == ""
    assert errors.count("\n") == 1, errors
    assert naming in errors


def test_a_body_of_100_megabytes(armed):
    before = unchanged(armed)
    host, port = armed.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))) as link:
        link.sendall(
            f"POST /v1/plans HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {TOKEN}\r\n"
            f"Content-Length: 100000000\r\n\r\n".encode()
        )
        assert b" 413 " in link.recv(200)
    assert unchanged(armed) == before


def test_a_body_that_announces_no_length(armed):
    def chunks():
        for _ in range(100):
            yield b" " * 100_000

    with contextlib.suppress(httpx.WriteError):  # the daemon may answer and close before everything was sent
        assert armed.client.post("/v1/plans", content=chunks()).status_code == 413
    assert armed.state()


def test_wrong_arguments(tmp_path):
    picture = tmp_path / "picture.png"
    picture.write_bytes(b"no picture at all")
    frames = tmp_path / "frames.json"
    frames.write_text(json.dumps({"frames": [frame()]}))
    assert_one_line(["config", "check", "--config", "nowhere.toml"], "nowhere.toml")
    assert_one_line(["plan", "nowhere.json"], "nowhere.json")
    assert_one_line(["plan", frames, "--out", "/nowhere/plan.csv"], "/nowhere/plan.csv")
    assert_one_line(["plan"], "FRAMES.json")
    assert_one_line(["plan", frames, "--colour"], "--colour")
    assert_one_line(["simulate", frames, "--pixels", "0,999"], "999")
    assert_one_line(["simulate", frames, "--dt", "0"], "--dt")
    assert_one_line(["flay"], "flay")


def test_a_picture_that_is_no_picture(armed, tmp_path):
    picture = tmp_path / "picture.png"
    picture.write_bytes(b"no picture at all")
    environment = {"OPTODRIVE_TOKEN": TOKEN}
    before = unchanged(armed)
    assert_one_line(["play", "image", f"file={picture}", "--url", armed.url], "picture", environment)
    assert_one_line(["play", "image", "file=nowhere.png", "--url", armed.url], "nowhere.png", environment)
    assert_one_line(["play", "imagine", "--url", armed.url], "'image'", environment)
    assert_one_line(["play", "experiment-1", "direction=sideways", "--url", armed.url], "sideways", environment)
    assert unchanged(armed) == before


def test_a_port_in_use(armed, tmp_path):
    port = armed.url.rpartition(":")[2]
    assert_one_line(["serve", "--port", port], "daemon.port", {"XDG_RUNTIME_DIR": str(tmp_path)})


def test_no_daemon(tmp_path):
    done = run_process(
        [OPTODRIVE, "status", "--url", "http://127.0.0.1:9"],
        capture_output=True,
        text=True,
        env={**os.environ, "OPTODRIVE_TOKEN": "x"},
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("run_command", "arguments"),
    [(run_process, ["serve", "--port", "0"]), (subprocess.run, ["config", "show", "--json"])],
    ids=["serve", "config"],
)
def test_a_full_disk_behind_stdout_ends_in_one_line(run_command, arguments, tmp_path):
    with Path("/dev/full").open("w") as full:
        done = run_command(
            [OPTODRIVE, *arguments],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)},
        )
    assert done.returncode == 1
    assert done.stderr == "optodrive: [Errno 28] No space left on device\n"
