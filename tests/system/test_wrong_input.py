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
from optodrive.device.config_file import locate_shipped
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


@pytest.mark.parametrize("case", BODIES)
def test_the_same_on_the_command_line_is_one_line_and_exit_2(case, tmp_path):
    body, _ = BODIES[case]
    path = tmp_path / "frames.json"
    path.write_text(body if isinstance(body, str) else json.dumps(body))
    assert_one_line(
        ["plan", path, "--out", tmp_path / "plan.csv"], "frames.json" if case != "target out of reach" else ""
    )
    assert not (tmp_path / "plan.csv").exists()


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


def test_a_wrong_token(armed):
    for header in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": f"Basic {TOKEN}"}):
        response = httpx.post(f"{armed.url}/v1/stop", headers=header)
        assert response.status_code == 401
        assert response.json()["code"] == "bad_token"
        assert TOKEN not in response.text
    assert armed.board_state() == "ARMED"
    assert_one_line(["status", "--url", armed.url], "token", {"OPTODRIVE_TOKEN": "wrong"})


def test_every_route_but_health_wants_the_token(armed):
    document = armed.call("GET", "/openapi.json")
    assert httpx.get(f"{armed.url}/openapi.json").status_code == 401
    seen = 0
    for path, methods in document["paths"].items():
        for method in methods:
            url = armed.url + path.replace("{plan_id}", "p1").replace("{name}", "pixel")
            status = httpx.request(method, url).status_code
            assert status == (200 if path == "/v1/health" else 401), path
            seen += 1
    assert seen >= 10


def test_a_foreign_host_and_a_foreign_origin(armed):
    host = armed.client.get("/v1/health", headers={"Host": "evil.example"})
    assert (host.status_code, host.json()["code"]) == (421, "host_not_allowed")
    origin = armed.client.get("/v1/state", headers={"Origin": "https://evil.example"})
    assert (origin.status_code, origin.json()["code"]) == (403, "origin_not_allowed")
    assert armed.client.get("/v1/state", headers={"Origin": armed.url}).status_code == 200


@pytest.mark.parametrize(
    ("path", "method", "status"),
    [
        ("/v1/plans/none", "GET", 404),
        ("/v1/plans/none", "DELETE", 404),
        ("/v1/patterns/experiment-7", "POST", 404),
        ("/v1/nothing", "GET", 404),
        ("/v1/arm", "GET", 405),
        ("/v1/plans?dry_run=perhaps", "POST", 422),
    ],
)
def test_what_is_not_there(armed, path, method, status):
    answer = armed.call(method, path, status=status, content=b"{}" if method == "POST" else None)
    assert answer["code"]


def test_policy_refuse_refuses_what_would_be_trimmed_or_late(armed):
    body = {"frames": [frame(duration_s=0.01, target_um=dict.fromkeys(map(str, range(40)), 100))]}
    answer = armed.call("POST", "/v1/plans?policy=refuse", status=409, json=body)
    assert answer["code"] == "refused"
    assert "needs" in answer["detail"]
    body = {"trains": [train(gap_s=0.0, pulse_width_s=0.05)]}
    answer = armed.call("POST", "/v1/plans?policy=refuse", status=409, json=body)
    assert "cap" in answer["detail"]


def test_a_dry_run_moves_nothing(armed):
    before = unchanged(armed)
    answer = armed.call("POST", "/v1/plans?dry_run=true", json={"frames": [frame()]})
    assert answer["status"] == "planned"
    assert answer["summary"]["predicted_max_um"] == pytest.approx(50.0, rel=1e-3)
    assert unchanged(armed) == before


CONFIGS = {
    "unknown key": ("damping =", "dampin =", "nearest is 'damping'"),
    "crossed limits": ("absorber_max_c = 400.0", "absorber_max_c = 10.0", "more than ambient_c 20.0"),
    "a wall hotter than an absorber": ("wall_max_c = 80.0", "wall_max_c = 500.0", "limits.wall_max_c"),
    "a touch surface below ambient": ("touch_max_c = 4", "touch_max_c = -4", "more than ambient_c 20.0"),
    "uncertainty beyond half": ("wall_capacity = 0.1", "wall_capacity = 1.5", "limits.uncertainty.wall_capacity"),
    "crossed powers": (
        "pixel_mean_power_max_w = 1.3",
        "pixel_mean_power_max_w = 9.0",
        "at most limits.display_mean_power_max_w 2.45",
    ),
    "wrong type": ("pwm_hz = 5000.0", 'pwm_hz = "fast"', "laser.pwm_hz"),
    "other version": ("version = 1", "version = 2", "version: got 2, expected 1"),
    "other format": ('format = "optodrive-config"', 'format = "svg"', "format"),
    "no TOML": ("[display]", "[display", "valid TOML"),
    "unreachable pixel": ("pitch_m = 3.6e-3", "pitch_m = 9e-3", "a reach of"),
    "unknown parameters": ('parameters = "surroundings"', 'parameters = "best"', "calibrated"),
}


@pytest.mark.parametrize("case", CONFIGS)
def test_wrong_configurations(case, tmp_path):
    old, new, naming = CONFIGS[case]
    text = locate_shipped("display-437.toml").read_text()
    assert old in text
    path = tmp_path / "config.toml"
    path.write_text(text.replace(old, new))
    assert_one_line(["config", "check", "--config", path], naming)


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
