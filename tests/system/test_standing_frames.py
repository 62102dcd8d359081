"""Frames that stand: refreshed until the next or until their client ends, under fingers first, and dark after STOP."""

import asyncio
import base64
import json
import os
import signal
import subprocess
import sys
from collections import Counter
from contextlib import contextmanager, suppress
from socket import create_connection

import numpy as np
import pytest
from websockets.sync.client import connect

from forked_process import OPTODRIVE, start_process
from optodrive.client import AsyncDisplay, Display
from optodrive.core.errors import BusyError, InputError, LinkError, NotReadyError
from optodrive.core.types.fingers import FingerPlace
from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import load_config
from rig import TOKEN, running, wait_for
from test_six_experiments import cell_codes
from test_telemetry import Reader

PAGE = tuple(range(100, 160))
PIXEL_OF = {tuple(codes): pixel for pixel, codes in enumerate(cell_codes().tolist())}
LAYOUT = build_pixel_layout(load_config().display)
PLACES = list(zip(LAYOUT.x_m.tolist(), LAYOUT.y_m.tolist(), strict=True))
FAR_M, LEAD = 0.01, 20
"""Without fingers the counts of the dots of a page differ by one or two pulses."""
CLIENT = """
import sys
from optodrive.client import Display

display = Display(sys.argv[1])
stream = display.stream(standing=True)
stream.send({pixel: 50.0 for pixel in range(100, 160)})
print("sent", flush=True)
sys.stdin.read()
"""


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    with running(tmp_path_factory.mktemp("standing")) as rig:
        yield rig


@pytest.fixture
def armed(rig):
    board, daemon = rig
    daemon.call("POST", "/v1/disarm")
    daemon.arm()
    board.forget()
    return board, daemon


@contextmanager
def socket(daemon, path):
    link = create_connection(("127.0.0.1", daemon.client.base_url.port))
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with connect(f"ws://127.0.0.1{path}", sock=link, additional_headers=headers, proxy=None, compression=None) as open_:
        yield open_


def show(daemon):
    return socket(daemon, "/v1/stream?standing=true")


def send_page(stream, pixels=PAGE, number=0, height_um=50.0):
    stream.send(json.dumps({"frame": number, "target_um": {str(pixel): height_um for pixel in pixels}}))
    return json.loads(stream.recv())


def count_pulses(board, since=0):
    return Counter(PIXEL_OF[pulse["x"], pulse["y"]] for pulse in board.of("pulse")[since:])


def compute_lead(board, finger, page):
    """Return how many more pulses the dot under a finger has than any dot that is far from it."""
    counts = count_pulses(board)
    far = [pixel for pixel in page if np.hypot(*np.subtract(PLACES[pixel], PLACES[finger])) > FAR_M]
    return counts[finger] - max(counts[pixel] for pixel in far)


def is_dark(daemon):
    state = daemon.state()
    return state["board"]["state"] in ("ARMED", "DISARMED") and not state["board"]["queued"]


def place(pixel, number=1):
    """Return the message of a finger on one pixel alone."""
    x_m, y_m = PLACES[pixel]
    return {"number": number, "x_m": x_m, "y_m": y_m, "radius_m": 0.001}


def test_a_frame_is_refreshed_until_the_next_one_and_dark_after_its_client(armed):
    board, daemon = armed
    with show(daemon) as stream:
        assert send_page(stream)["status"] == "planned"
        wait_for(lambda: min(count_pulses(board)[pixel] for pixel in PAGE) >= 3, "three pulses of every dot")
        assert set(count_pulses(board)) == set(PAGE)
        answers = [send_page(stream, (7, 8), 1), json.loads(stream.recv())]
        assert {answer["status"] for answer in answers} == {"planned", "superseded"}
        wait_for(lambda: count_pulses(board)[7] >= 3, "three pulses of the next frame")
        since = len(board.of("pulse"))
        wait_for(lambda: count_pulses(board, since)[7] >= 3, "three further pulses")
        assert set(count_pulses(board, since)) == {7, 8}
    wait_for(lambda: is_dark(daemon), "the light to end")
    emitted = len(board.of("pulse"))
    daemon.call("POST", "/v1/plans", json={"frames": [{"show_at_s": 0, "duration_s": 1, "target_um": {"3": 50}}]})
    wait_for(lambda: count_pulses(board)[3], "light of another caller")
    assert len(board.of("pulse")) == emitted + 1


def test_stop_ends_it_and_arming_does_not_bring_it_back(armed):
    board, daemon = armed
    with show(daemon) as stream:
        send_page(stream)
        wait_for(lambda: len(board.of("pulse")) > 50, "light")
        daemon.call("POST", "/v1/stop")
        refused = json.loads(stream.recv())
        assert (refused["frame"], refused["status"]) == (0, "refused")
        assert refused["problem"]["code"] in ("stopped", "not_ready")
        daemon.arm()
        emitted = len(board.of("pulse"))
        daemon.call("POST", "/v1/plans", json={"frames": [{"show_at_s": 0, "duration_s": 1, "target_um": {"3": 50}}]})
        wait_for(lambda: count_pulses(board)[3], "light of another caller")
        assert len(board.of("pulse")) == emitted + 1
        assert send_page(stream, number=1)["status"] == "planned"
        wait_for(lambda: len(board.of("pulse")) > emitted + 50, "light of a new frame")


def test_a_client_that_is_killed_leaves_the_display_dark(armed):
    board, daemon = armed
    environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN}
    client = subprocess.Popen(
        [sys.executable, "-c", CLIENT, daemon.url], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
    )
    with client:
        client.stdout.readline()
        wait_for(lambda: len(board.of("pulse")) > 100, "light")
        client.send_signal(signal.SIGKILL)
    wait_for(lambda: is_dark(daemon), "the light to end")


def test_dots_under_fingers_get_more_light_than_others_and_the_whole_page_without(armed):
    board, daemon = armed
    finger, page = 120, tuple(range(50, 400))
    with show(daemon) as stream:
        send_page(stream, page)
        with socket(daemon, "/v1/fingers") as fingers:
            touched = json.dumps({"fingers": [place(finger)], "age_s": 0.0})

            def find_lead():
                fingers.send(touched)
                return compute_lead(board, finger, page)

            wait_for(lambda: find_lead() >= LEAD, "more light under the finger")
        since = len(board.of("pulse"))
        wait_for(lambda: min(count_pulses(board, since)[pixel] for pixel in page) >= 1, "the whole page")


def decode_page(event):
    return np.flatnonzero(np.frombuffer(base64.b64decode(event["height"]), dtype="<u2"))


def test_telemetry_says_where_fingers_are_and_what_their_dots_get(armed):
    _board, daemon = armed
    finger, page = 120, tuple(range(50, 400))
    reader = Reader(daemon)
    touched = json.dumps({"fingers": [place(finger)], "age_s": 0.0})
    with show(daemon) as stream:
        send_page(stream, page)
        with socket(daemon, "/v1/fingers") as fingers:

            def is_seen():
                fingers.send(touched)
                event = reader.last("fingers")
                return event and event["fingers"] and (event["fingers"][0]["height_share"] or 0.0) > 0.9

            wait_for(is_seen, "a dot that is as high as its page")
            (seen,) = reader.last("fingers")["fingers"]
            assert (seen["number"], seen["dots"], seen["radius_m"]) == (1, 1, 0.001)
            assert (seen["x_m"], seen["y_m"]) == pytest.approx(PLACES[finger], abs=1e-4)
            assert seen["rate_hz"] > 0.0
            assert decode_page(reader.last("page")).tolist() == list(page)
        wait_for(lambda: reader.last("fingers")["tracker"] == "lost", "the tracker to be lost")
        assert reader.last("fingers")["fingers"] == []
    wait_for(lambda: reader.last("page")["height"] == "", "the page to end")
    reader.close()


def test_telemetry_names_the_caps_that_take_light_from_a_page_while_they_do(armed):
    _board, daemon = armed
    reader = Reader(daemon)
    with show(daemon) as stream:
        answer = send_page(stream, (120,), height_um=500.0)
        while not answer.get("limited_by"):
            answer = json.loads(stream.recv())
        for cap in answer["limited_by"]:
            wait_for(lambda cap=cap: cap in reader.last("page")["limited_by"], f"{cap} in the telemetry")
        send_page(stream, (200,), 1)
        wait_for(lambda: not reader.last("page")["limited_by"], "the end of all caps")
    reader.close()


def test_places_that_have_waited_behind_others_are_refused_until_the_socket_is_empty(armed):
    """Faster than the caller's rate, places would be seconds old when their turn comes."""
    _board, daemon = armed
    reader, touched = Reader(daemon), json.dumps({"fingers": [place(120)], "age_s": 0.0})
    with socket(daemon, "/v1/fingers") as fingers:

        def send_many():
            for _ in range(200):
                fingers.send(touched)
            with suppress(TimeoutError):
                return json.loads(fingers.recv(timeout=0))["problem"]

        problem = wait_for(send_many, "the refusal of a backlog")
        assert problem["code"] == "busy"
        assert "waited behind others" in problem["detail"]

        def is_seen():
            fingers.send(touched)
            return reader.last("fingers")["tracker"] == "seen"

        wait_for(lambda: reader.last("fingers")["tracker"] == "lost", "the tracker to be lost")
        wait_for(is_seen, "the tracker after the backlog")
    reader.close()


@pytest.mark.parametrize(
    ("message", "detail"),
    [
        ('{"fingers": [{"number": 1, "x_m": "a", "y_m": 0, "radius_m": 0.004}]}', "message: fingers.0.x_m: got 'a'"),
        ('{"fingers": [], "fingers": []}', "each key of an object once"),
    ],
)
def test_a_wrong_message_of_fingers_gets_one_line_and_nothing_else_changes(rig, message, detail):
    with socket(rig[1], "/v1/fingers") as fingers:
        fingers.send(message)
        problem = json.loads(fingers.recv())["problem"]
        assert detail in problem["detail"]
        assert "\n" not in problem["detail"]
        fingers.send(message)
        assert json.loads(fingers.recv())["problem"] == problem


def test_the_asynchronous_client_refuses_a_wrong_place_and_sends_the_next_one(rig, monkeypatch):
    monkeypatch.setenv("OPTODRIVE_TOKEN", TOKEN)

    async def report():
        async with AsyncDisplay(rig[1].url) as display, display.fingers() as fingers:
            with pytest.raises(InputError, match=r"^message: fingers\.0\.x_m: got 2\.0, expected less than"):
                await fingers.send([FingerPlace(1, 2.0, 0.0, 0.004)])
            await fingers.send([FingerPlace(1, 0.0, 0.0, 0.004)])
            await fingers.close()
            with pytest.raises(LinkError, match="closed the connection"):
                await fingers.send([])
            with pytest.raises(NotReadyError, match="is not open"):
                await display.fingers().send([])

    asyncio.run(report())


def test_the_client_says_once_that_places_waited_and_sends_the_next_ones(rig, monkeypatch):
    monkeypatch.setenv("OPTODRIVE_TOKEN", TOKEN)
    touched = [FingerPlace(1, 0.0, 0.0, 0.004)]
    with Display(rig[1].url) as display, display.fingers() as fingers:

        def find_refusal():
            try:
                for _ in range(200):
                    fingers.send(touched)
            except BusyError as error:
                return str(error)

        assert "waited behind others" in wait_for(find_refusal, "the refusal of a backlog")
        fingers.send(touched)


def test_a_script_of_fingers_brings_light_under_them(armed, tmp_path):
    board, daemon = armed
    finger, page = 120, tuple(range(50, 400))
    x_m, y_m = PLACES[finger]
    script = tmp_path / "hand.csv"
    rows = "".join(f"{0.01 * k:.2f},1,{x_m},{y_m},0.001\n" for k in range(100))
    script.write_text(f"time_s,number,x_m,y_m,radius_m\n{rows}")
    environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN, "OPTODRIVE_URL": daemon.url}
    with show(daemon) as stream:
        send_page(stream, page)
        with start_process([OPTODRIVE, "fingers", script, "--repeat"], env=environment) as command:
            wait_for(lambda: compute_lead(board, finger, page) >= LEAD, "more light under the finger")
            command.send_signal(signal.SIGINT)
            assert command.wait() == 130
