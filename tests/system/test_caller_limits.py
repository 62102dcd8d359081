"""The cost of one caller's hostile requests to the others: a running show, a push, memory, the audit log."""

import fcntl
import json
import os
import socket
from base64 import b64encode
from contextlib import ExitStack
from types import SimpleNamespace

import httpx
import pytest

from floods import build_full_frames, build_refused_bodies
from optodrive.daemon.api.tokens import Token, add_token
from optodrive.daemon.preview.process import HEAVY_MAX
from pushes import RawPush, sent_dry_run, suspend_dry_runs
from rig import PATIENT_LEASE_S, TOKEN, Daemon, is_suspended, read_role_tokens, running, wait_for
from stop_rig import PIXELS, StopRig, is_gate_on
from test_security import build_bearer_header, build_daemon_replacement

LONG_RUN = 730
"""Frames of a dry run that takes seconds."""
SMALL = b'{"frames":[{"show_at_s":0,"duration_s":1,"target_um":{"17":60}}]}'


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("limits")
    rig = StopRig(folder, options=f'audit = "{folder}/audit.jsonl"\nsocket = "{folder}/s"')
    yield rig
    rig.close()


@pytest.fixture(scope="module")
def crowd(tmp_path_factory):
    """A daemon with the callers `heavy-0` to `heavy-7`, whose secrets are their names four times."""
    folder = tmp_path_factory.mktemp("crowd")
    callers = [Token("light", "armer", TOKEN), *(Token(f"heavy-{k}", "operator", f"heavy-{k}" * 4) for k in range(8))]
    for caller in callers:
        add_token(folder / "tokens.toml", caller)
    section = f'[daemon]\ntokens = "{folder}/tokens.toml"\naudit = "{folder}/audit.jsonl"\n#'
    line = f"lease_s = {PATIENT_LEASE_S}"
    with running(folder, replace=((line, f"{line}\n{section}"),)) as (_, daemon):
        daemon.arm()
        yield SimpleNamespace(daemon=daemon)


def post(rig, body, path="/v1/plans", role="operator", **params):
    return post_as(rig, body, path, read_role_tokens(rig.daemon)[role], **params)


def post_as(rig, body, path, secret, **params):
    headers = build_bearer_header(secret)
    return httpx.post(rig.daemon.url + path, params=params, content=body, headers=headers, timeout=None)


def read_audit(rig, call):
    """Return the lines of the audit log about a call."""
    lines = (rig.daemon.config.parent / "audit.jsonl").read_text().splitlines(keepends=True)
    return [line for line in map(json.loads, filter(is_complete, lines)) if line.get("call") == call]


def is_complete(line):
    return line.endswith("\n")


def await_light(rig):
    """Wait for light that begins from now on."""
    rig.tail.read()
    rig.tail.find(is_gate_on, len(rig.tail.events), "further light")


def test_refused_bodies_of_8_MB_do_not_darken_a_show(rig):
    bodies = build_refused_bodies(PIXELS)
    with rig.running_show() as begin:
        statuses = [post(rig, body).status_code for body in bodies]
        await_light(rig)
        assert rig.find_darkness(begin) == []
    assert set(statuses) <= {413, 422, 503}


@pytest.mark.parametrize(("count", "frames"), [(5, LONG_RUN), pytest.param(1, 5_600, marks=pytest.mark.slow)])
def test_abandoned_dry_runs_do_not_hold_up_another_callers_push(rig, count, frames):
    """The one that runs is suspended: who waited for it would wait until it is refused for its duration."""
    rig.arm()
    audited = len(read_audit(rig, "POST /v1/plans"))
    with ExitStack() as stack:
        for _ in range(count):
            stack.enter_context(sent_dry_run(rig.daemon, build_full_frames(frames, PIXELS)))
        suspended = wait_for(lambda: suspend_dry_runs(rig.daemon), "a dry run")
        assert post(rig, SMALL, role="armer").status_code == 201
    wait_for(lambda: len(read_audit(rig, "POST /v1/plans")) == audited + 1 + count, "the lines of the dry runs")
    # The web process has dropped all of them, so the next request follows the drops to the preview process.
    assert post(rig, SMALL, role="armer").status_code == 201
    assert not any(map(is_suspended, suspended)), "a dry run that nobody waits for was not killed"
    wait_for(lambda: not suspend_dry_runs(rig.daemon), "an end without a further dry run, which would be suspended")
    rig.client.post("/v1/stop")
    pushed, *abandoned = read_audit(rig, "POST /v1/plans")[audited : audited + 1 + count]
    assert (pushed["name"], pushed["status"]) == ("armer", 201)
    said = [(line["name"], line["status"], line.get("hung_up"), line.get("plan")) for line in abandoned]
    assert said == [("operator", None, True, None)] * count


@pytest.mark.parametrize("callers", [*(pytest.param(each, marks=pytest.mark.slow) for each in (3, 4)), 8])
def test_light_pushes_pass_all_heavy_callers(crowd, callers):
    """In the audit log, pushes stand before all drawings, which were sent first; as many as may run are suspended."""
    arcs = "A5 5 0 0 1 9 9A5 5 0 0 1 0 0" * 50_000
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9" stroke="red"><path d="M0 0{arcs}"/></svg>'
    drawing = json.dumps({"file": b64encode(svg.encode()).decode()}).encode()
    path = crowd.daemon.config.parent / "audit.jsonl"
    before = len(path.read_text().splitlines()) if path.exists() else 0
    with ExitStack() as stack:
        for k in range(callers):
            push = RawPush(crowd.daemon, len(drawing), "/v1/patterns/drawing", f"heavy-{k}" * 4)
            stack.enter_context(push).send(drawing)
        wait_for(lambda: len(suspend_dry_runs(crowd.daemon)) == HEAVY_MAX, "slow builds")
        for _ in range(3):
            assert post_as(crowd, SMALL, "/v1/plans", TOKEN).status_code == 201
    lines = wait_for(lambda: (found := path.read_text().splitlines()[before:])[callers + 2 :] and found, "all lines")
    said = [(line["name"], line["status"]) for line in map(json.loads, lines)]
    assert said[:3] == [("light", 201)] * 3
    assert sorted(said[3:]) == [(f"heavy-{k}", None) for k in range(callers)]


def test_a_body_that_hangs_up_logs_no_traceback(rig):
    base = rig.client.base_url
    audited = len(read_audit(rig, "POST /v1/plans"))
    for role in ("operator", "viewer"):
        with socket.create_connection((base.host, base.port)) as link:
            head = f"POST /v1/plans HTTP/1.1\r\nHost: {base.host}\r\nContent-Length: 1000\r\n"
            head += f"Authorization: Bearer {read_role_tokens(rig.daemon)[role]}\r\n\r\n"
            link.sendall(head.encode() + b"{")
    lines = wait_for(lambda: (found := read_audit(rig, "POST /v1/plans")[audited:])[1:] and found, "both lines")
    assert {(line["name"], line["event"], line.get("hung_up")) for line in lines} == {
        ("operator", "answered", True),
        ("viewer", "refused", None),
    }
    rig.daemon.state()  # answered after both
    assert "Traceback" not in rig.daemon.errors.read_text()


def test_an_audit_path_that_hangs_delays_neither_STOP_nor_the_end(make_board, tmp_path):
    """A FIFO that nobody reads any more: a wait until it takes a line would never end."""
    board, fifo = make_board(), tmp_path / "audit"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    fcntl.fcntl(reader, fcntl.F_SETPIPE_SZ, 4096)
    daemon = Daemon(tmp_path, board.port, replace=build_daemon_replacement(f'audit = "{fifo}"'))
    try:
        for _ in range(61):  # more lines than the pipe holds
            daemon.call("POST", "/v1/stop")
        wait_for(lambda: "cannot be written" in daemon.errors.read_text(), "the line about the audit log")
        daemon.call("POST", "/v1/stop")
        daemon.process.terminate()
        assert daemon.process.wait() == 0
    finally:
        os.close(reader)
        daemon.stop()
