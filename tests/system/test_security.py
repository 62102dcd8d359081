"""Access control on the real daemon; tests/unit/daemon/api/test_roles.py tries every route."""

import asyncio
import json
import os
import socket

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from forked_process import run_process
from optodrive.client import AsyncDisplay, Display
from optodrive.core.errors import NotReadyError, RefusedError
from optodrive.daemon.api.route_table import STOP
from optodrive.daemon.api.static_files import LOGIN_PATHS
from rig import OPTODRIVE, TOKEN, Board, Daemon, read_role_tokens, wait_for

LAST_LINE = "lease_s = 1.0"


def build_daemon_replacement(text):
    """Return the replacement that appends a [daemon] section to the configuration."""
    return ((LAST_LINE, f"{LAST_LINE}\n[daemon]\n{text}\n#"),)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("security")


@pytest.fixture(scope="module")
def running(folder):
    board = Board(folder)
    text = f'socket = "{folder}/s"\naudit = "{folder}/audit.jsonl"\nrequests_per_s = 1e5\nrequests_burst = 100000'
    try:
        daemon = Daemon(folder, board.port, replace=build_daemon_replacement(text))
        try:
            yield daemon
        finally:
            daemon.stop()
    finally:
        board.stop()


def build_bearer_header(secret):
    return {"Authorization": f"Bearer {secret}"}


def test_the_files_of_the_login_are_public_and_hold_no_secret(running):
    for path in LOGIN_PATHS:
        response = httpx.get(running.url + path, timeout=None)
        assert response.status_code == 200
        assert TOKEN not in response.text


def test_the_unix_socket_requires_the_token(running, folder):
    assert (folder / "s").stat().st_mode & 0o777 == 0o660
    with httpx.Client(
        transport=httpx.HTTPTransport(uds=str(folder / "s")), base_url="http://localhost", timeout=None
    ) as client:
        assert client.get("/v1/health").status_code == 200
        assert client.get("/v1/state").status_code == 401
        assert client.get("/v1/state", headers=build_bearer_header(TOKEN)).status_code == 200
        assert client.get("/v1/state", headers=build_bearer_header(TOKEN) | {"Host": "evil.example"}).status_code == 421


def test_command_line_and_client_use_the_unix_socket(running, folder):
    place = f"unix:{folder / 's'}"
    environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN}
    command = [OPTODRIVE, "status", "--url", place, "--json"]
    output = run_process(command, capture_output=True, text=True, env=environment, check=True).stdout
    assert json.loads(output)["display"] == running.state()["display"]
    with Display(place, TOKEN) as display:
        assert display.show({5: 60.0}, dry_run=True).planned == 1
        with display.stream() as stream, pytest.raises(NotReadyError):
            stream.wait(stream.send({5: 60.0}))

    async def asynchronously():
        async with AsyncDisplay(place, TOKEN) as display, display.stream() as stream:
            with pytest.raises(NotReadyError):
                await stream.wait(await stream.send({5: 60.0}))

    asyncio.run(asynchronously())
    gone = run_process([*command[:3], place + "x"], capture_output=True, text=True, env=environment)
    assert gone.returncode == 1
    assert gone.stderr.count("\n") == 1
    assert place + "x" in gone.stderr


def send_raw(daemon, request):
    host, port = daemon.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))) as link:
        link.sendall(request.encode())
        return link.recv(300).decode()


@pytest.mark.parametrize(
    "body", ["Content-Length: 100000000\r\n\r\n", "Transfer-Encoding: chunked\r\n\r\nffffff\r\n", "\r\n"]
)
def test_stop_does_not_wait_for_the_body(running, body):
    path = STOP.partition(" ")[2]
    secret = read_role_tokens(running)["viewer"]
    given = send_raw(running, f"POST {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {secret}\r\n{body}")
    assert given.startswith("HTTP/1.1 200 ")


@pytest.mark.parametrize("target", ["/v1/stop/", "http://localhost/v1/stop", "HTTP://127.0.0.1:1/v1/stop/?now=1"])
def test_stop_in_any_form_of_its_address_stops(running, target):
    request = f"POST {target} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {TOKEN}\r\n\r\n"
    assert send_raw(running, request).startswith("HTTP/1.1 200 ")


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ("Host: localhost\r\n" + "Origin: http://localhost\r\n", 200),
        ("Host: localhost\r\n" + "Origin: http://localhost\r\n" * 2, 403),
        ("Host: localhost\r\n" + "Origin: https://evil.example\r\nOrigin: http://localhost\r\n", 403),
        ("Host: localhost\r\n" + f"Authorization: Bearer {TOKEN}\r\n", 401),
    ],
)
def test_a_header_that_is_there_twice_counts_as_none_of_both(running, headers, status):
    request = f"GET /v1/me HTTP/1.1\r\nAuthorization: Bearer {TOKEN}\r\n{headers}\r\n"
    assert send_raw(running, request).startswith(f"HTTP/1.1 {status} ")


def test_a_refusal_names_both_roles_wherever_it_is_read(running, folder):
    """On REST, on a WebSocket, in its header, by the client and by the command line."""
    tokens = read_role_tokens(running)
    roles = "requires a token of role {}; token 'viewer' has role viewer"
    viewer = build_bearer_header(tokens["viewer"])
    refused = httpx.post(running.url + "/v1/arm", headers=viewer, timeout=None)
    assert roles.format("armer") in refused.json()["detail"]
    assert refused.headers["www-authenticate"] == 'Bearer error="insufficient_scope", scope="armer"'
    with pytest.raises(InvalidStatus) as refusal:
        connect(running.url.replace("http", "ws") + "/v1/stream", additional_headers=viewer, proxy=None)
    response = refusal.value.response
    assert roles.format("operator") in json.loads(response.body)["detail"]
    assert response.headers["www-authenticate"] == 'Bearer error="insufficient_scope", scope="operator"'
    with Display(running.url, tokens["viewer"]) as display:
        with pytest.raises(RefusedError, match=roles.format("armer")):
            display.arm()
        with pytest.raises(RefusedError, match=roles.format("armer")):
            display.arm(hold=True)
        with pytest.raises(RefusedError, match=roles.format("operator")), display.stream() as stream:
            stream.wait(stream.send({5: 60.0}))
    environment = {**os.environ, "OPTODRIVE_TOKEN": tokens["viewer"]}
    done = run_process([OPTODRIVE, "arm", "--url", running.url], capture_output=True, text=True, env=environment)
    assert roles.format("armer") in done.stderr


def test_the_start_says_which_token_is_for_what(running):
    said = running.announcement
    assert "viewer reads and stops, operator also plays, pauses and dims, armer also arms" in said
    assert not any(secret in said for secret in read_role_tokens(running).values())


def test_what_is_no_request_fills_no_log(running):
    before = running.errors.read_text()
    for _ in range(30):
        assert send_raw(running, "NO REQUEST\r\n\r\n").startswith("HTTP/1.1 400 ")
    assert running.errors.read_text().removeprefix(before).count("Invalid HTTP request") <= 3


def read_audit(folder):
    return [json.loads(line) for line in (folder / "audit.jsonl").read_text().splitlines()]


def test_the_audit_file_names_user_and_action(running, folder):
    secrets = read_role_tokens(running)
    running.arm()
    body = json.dumps({"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"17": 50}}]})
    plan = running.call("POST", "/v1/plans", content=body, headers=build_bearer_header(secrets["operator"]))["plan"]
    running.call("POST", "/v1/arm", status=403, headers=build_bearer_header(secrets["viewer"]))
    forged = {"X-Forwarded-For": "10.1.2.3", "X-Real-IP": "10.1.2.3"}
    running.call("POST", "/v1/stop", headers=build_bearer_header(secrets["viewer"]) | forged)
    running.call("GET", "/v1/state")

    def look():
        lines = read_audit(folder)
        begin = next(index for index, line in enumerate(lines) if line["event"] == "requested")
        return lines[begin:] if any(line["call"] == "POST /v1/stop" for line in lines[begin:]) else None

    lines = wait_for(look, "the stop's line")
    said = [(line["name"], line["role"], line["call"], line["event"], line.get("status")) for line in lines]
    assert said == [
        ("armer", "armer", "POST /v1/arm", "requested", None),
        ("armer", "armer", "POST /v1/arm", "answered", 200),
        ("operator", "operator", "POST /v1/plans", "answered", 201),
        ("viewer", "viewer", "POST /v1/arm", "refused", 403),
        ("viewer", "viewer", "POST /v1/stop", "answered", 200),
    ]
    assert (lines[2]["plan"], lines[2]["body_bytes"]) == (plan, len(body))
    assert len(lines[2]["body_sha256"]) == 64
    assert {line["address"] for line in lines} == {"127.0.0.1"}


def test_no_token_is_written(running, folder):
    running.call("GET", "/v1/state", status=401, headers=build_bearer_header("s3cret-that-is-wrong"))
    httpx.get(f"{running.url}/v1/state?token={TOKEN}", timeout=None)
    secrets = [*read_role_tokens(running).values(), "s3cret-that-is-wrong"]
    for path in (running.errors, folder / "audit.jsonl"):
        text = path.read_text()
        assert not [secret for secret in secrets if secret in text], path


def collect_until_refused(call):
    """Call until the rate limit refuses. Return the statuses before that, and the refusal."""
    statuses = []
    while (response := call()).status_code != 429:
        statuses.append(response.status_code)
    return statuses, response


def test_the_rate_limit_applies_per_client_and_not_to_stop(make_daemon, board, tmp_path):
    daemon = make_daemon(board, replace=build_daemon_replacement("requests_per_s = 1\nrequests_burst = 20"))
    secrets = read_role_tokens(daemon)
    with (
        httpx.Client(base_url=daemon.url, headers=build_bearer_header(secrets["viewer"]), timeout=None) as viewer,
        httpx.Client(base_url=daemon.url, timeout=None) as anonymous,
    ):
        statuses, refusal = collect_until_refused(lambda: viewer.get("/v1/state"))
        assert len(statuses) >= 20
        assert set(statuses) == {200}
        assert int(refusal.headers["retry-after"]) >= 1
        assert refusal.json()["code"] == "too_many_requests"
        assert [viewer.post("/v1/stop").status_code for _ in range(50)] == [200] * 50
        collect_until_refused(lambda: viewer.get("/v1/config"))
        headers = build_bearer_header(secrets["operator"])
        assert anonymous.get("/v1/state", headers=headers).status_code == 200
        statuses, _ = collect_until_refused(lambda: anonymous.get("/v1/state"))
        assert set(statuses) == {401}
        assert anonymous.post("/v1/stop").status_code == 401
