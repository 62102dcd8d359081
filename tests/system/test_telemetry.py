"""Telemetry of the daemon: contents and rate of the events, and slow readers."""

import base64
import json
import os
import pty
import re
import subprocess
import threading

import httpx
import numpy as np
import pytest

from board_fixtures import board_disarmed, daemon_disarmed  # noqa: F401 - fixtures
from optodrive.daemon.responses.telemetry import EVENTS
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from rig import OPTODRIVE, TOKEN, config_text, long_train, wait_for


class Reader:
    """Reader of the telemetry in a thread, with events as (kind, data). was_cut: whether the stream broke off."""

    def __init__(self, daemon, query=""):
        self.events = []
        self.was_cut = False
        self.ended = threading.Event()
        self._closing = False
        self._url = f"{daemon.url}/v1/telemetry{query}"
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self):
        headers = {"Authorization": f"Bearer {TOKEN}"}
        kind = None
        try:
            with httpx.stream("GET", self._url, headers=headers, timeout=None) as answer:
                assert answer.headers["content-type"].startswith("text/event-stream")
                for line in answer.iter_lines():
                    if line.startswith("event: "):
                        kind = line[7:]
                    elif line.startswith("data: "):
                        EVENTS[kind].model_validate_json(line[6:])
                        self.events.append((kind, json.loads(line[6:])))
                    if self._closing:
                        return
        except httpx.TransportError:
            self.was_cut = True
        finally:
            self.ended.set()

    def of(self, kind):
        return [data for name, data in list(self.events) if name == kind]

    def last(self, kind):
        found = self.of(kind)
        return found[-1] if found else None

    def close(self):
        self._closing = True
        self._thread.join()


@pytest.fixture
def reader(daemon):
    readers = []

    def make(query=""):
        readers.append(Reader(daemon, query))
        return readers[-1]

    yield make
    for item in readers:
        item.close()


def executed(follower, plan):
    """Return the executed batches of a plan. Batches of earlier plans may be repeated."""
    batches = [batch for event in follower.of("pulses") for batch in event["executed"]]
    return [batch for batch in batches if batch["plan"] == plan]


def list_rows(follower, plan):
    """Return the rows of a plan that are reported as executed."""
    return [row for batch in executed(follower, plan) for row in batch["row"]]


def heights_um(event):
    return np.frombuffer(base64.b64decode(event["height"]), dtype="<u2") / 10


def peaks_um(event):
    return np.frombuffer(base64.b64decode(event["height_peak"]), dtype="<u2") / 10


def celsius(event):
    return np.frombuffer(base64.b64decode(event["absorber"]), dtype="<u2") / 10


def test_a_new_reader_gets_all_events_at_once(daemon, reader):
    follower = reader()
    wait_for(lambda: {"state", "display", "budget", "fault"} <= {kind for kind, _ in follower.events}, "one of each")
    assert follower.last("state")["board"]["state"] == "DISARMED"
    assert follower.last("fault")["fault"] is None
    assert len(heights_um(follower.last("display"))) == 437
    wait_for(lambda: not follower.last("display")["warm"], "the last test's heat to be gone")
    assert set(celsius(follower.last("display")).tolist()) == {20.0}
    states = len(follower.of("state"))
    wait_for(lambda: len(follower.of("state")) >= states + 3, "states though nothing changes")


def test_the_display_event_agrees_with_the_executed_pulses(daemon, reader):
    follower = reader("?rate_hz=60")
    daemon.arm()
    answer = daemon.call(
        "POST", "/v1/plans", json={"frames": [{"show_at_s": 1.5, "duration_s": 1, "target_um": {"17": 150}}]}
    )
    done = daemon.finished(answer["plan"])
    wait_for(
        lambda: (
            follower.of("display")
            and not follower.last("display")["warm"]
            and any(event["warm"] for event in follower.of("display"))
        ),
        "warm, then cold",
    )
    batches = executed(follower, answer["plan"])
    assert [(batch["plan"], batch["pixel"], batch["row"]) for batch in batches] == [(answer["plan"], [17], [0])]
    (batch,) = batches
    heat = DisplayModel.from_config(load_config()).build_cold_heat()
    heat.apply_pulses(*(np.array(batch[key]) for key in ("pixel", "start_s", "width_s", "power_w")))
    events = [event for event in follower.of("display") if event["warm"]]
    assert events
    for event in events:
        expected = heat.state_at(event["board_s"])
        assert heights_um(event) == pytest.approx(expected.displacement_m * 1e6, abs=0.2)
        assert (peaks_um(event) >= heights_um(event)).all()
        assert celsius(event) == pytest.approx(20.0 + expected.absorber_k, abs=0.2)
    assert max(peaks_um(event)[17] for event in events) == pytest.approx(done["simulated_max_um"], abs=0.1)
    announced = [batch for event in follower.of("pulses") for batch in event["planned"]]
    planned = [batch for batch in announced if batch["plan"] == answer["plan"]]
    assert planned[0]["start_s"] == pytest.approx(batches[0]["start_s"], abs=2e-3)
    assert planned[0]["width_s"] == pytest.approx(batches[0]["width_s"], abs=1e-6)


def test_every_executed_pulse_is_reported_once_even_without_a_reader_at_first(daemon, reader):
    daemon.arm()
    before = daemon.state()["totals"]["executed"]
    answer = daemon.call("POST", "/v1/plans", json=long_train(seconds=2.0))
    wait_for(lambda: daemon.state()["totals"]["executed"] > before + 20, "emission before the first reader")
    follower = reader()
    daemon.finished(answer["plan"])
    wait_for(lambda: len(list_rows(follower, answer["plan"])) >= answer["planned"], "all pulses")
    assert sorted(list_rows(follower, answer["plan"])) == list(range(answer["planned"]))


def test_trimmed_pulses_have_their_reason_and_the_budget_rises(daemon, reader):
    follower = reader()
    daemon.arm()
    train = long_train(seconds=3.0)
    train["trains"][0] |= {"pulse_width_s": 0.040, "gap_s": 0.001, "power_w": 2.4}
    answer = daemon.call("POST", "/v1/plans", json=train)
    assert answer["summary"]["trimmed"]["pulses"]
    daemon.finished(answer["plan"])
    wait_for(lambda: len(list_rows(follower, answer["plan"])) == answer["planned"], "all pulses")
    batches = executed(follower, answer["plan"])
    reasons = {
        reason for batch in batches for reason, taken in zip(batch["reason"], batch["trimmed_j"], strict=True) if taken
    }
    assert reasons == set(answer["summary"]["trimmed"]["by_reason"])
    shares = {cap["cap"]: [] for cap in follower.last("budget")["caps"]}
    for event in follower.of("budget"):
        for cap in event["caps"]:
            shares[cap["cap"]].append(cap["fraction"])
            assert cap["fraction"] <= 1.01
    assert max(max(values) for values in shares.values()) > 0.7


def test_sigterm_does_not_wait_for_telemetry_readers(make_board, make_daemon):
    daemon = make_daemon(make_board())
    follower = Reader(daemon)
    wait_for(lambda: follower.events, "events")
    daemon.process.terminate()
    assert daemon.process.wait() == 0
    follower.ended.wait()
    assert not follower.was_cut, "the daemon waited for the reader until it cut its stream"
    assert "Traceback" not in daemon.errors.read_text()


def test_the_files_of_the_page_and_no_others_are_served(daemon):
    index = daemon.client.get("/")
    assert index.headers["content-type"].startswith("text/html")
    assert "default-src 'self'" in index.headers["content-security-policy"]
    parts = [part.split('"')[0] for part in index.text.split('="page/')[1:]]
    assert "main.js" in parts
    for part in parts:
        answer = daemon.client.get(f"/page/{part}")
        assert answer.status_code == 200
        assert answer.headers["x-content-type-options"] == "nosniff"
    for path in ("/page/../api.py", "/page/%2e%2e/api.py", "/page/vendor", "/page/"):
        assert daemon.client.get(path).status_code == 404


def test_no_token_is_printed_where_no_terminal_is(make_board, make_daemon):
    daemon = make_daemon(make_board())
    daemon.process.terminate()
    assert TOKEN not in daemon.process.stdout.read()
    assert TOKEN not in daemon.errors.read_text()


def test_a_terminal_alone_is_shown_the_address_with_the_token(make_board, tmp_path):
    config = tmp_path / "config.toml"
    config.write_text(config_text(make_board().port))
    leader, follower = pty.openpty()
    environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN, "XDG_RUNTIME_DIR": str(tmp_path)}
    process = subprocess.Popen(
        [OPTODRIVE, "serve", "--config", config, "--port", "0"], stdout=follower, env=environment
    )
    os.close(follower)
    try:
        text = ""
        while "arm with" not in text:
            text += os.read(leader, 4096).decode()
        address = re.search(r"(http://127\.0\.0\.1:\d+/)#token=(\S+)", text)
        assert address
        assert address.group(2) == TOKEN
        assert httpx.get(address.group(1), timeout=None).status_code == 401
    finally:
        process.terminate()
        process.wait()
        os.close(leader)
