"""Nothing accepted before a STOP or a disarm is lit after it, judged from the board's log."""

import socket
import threading
import time

import httpx
import pytest

from floods import build_full_frames
from stop_rig import PIXELS, StopRig

LARGE_FRAMES = 400
AFTER_S = 1.5
"""Time for which the board must stay dark once it is armed again and every push is answered."""
SMALL = b'{"frames":[{"show_at_s":0,"duration_s":1,"target_um":{"17":60,"18":60,"19":60}}]}'


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    rig = StopRig(tmp_path_factory.mktemp("final"))
    yield rig
    rig.close()


class Push:
    """A push in a thread of its own; response: None before the answer."""

    def __init__(self, rig, body, **params):
        self.response = None
        self._client = httpx.Client(base_url=rig.daemon.url, headers=rig.client.headers, timeout=90)
        self._thread = threading.Thread(target=self._send, args=(body, params))
        self._thread.start()

    def _send(self, body, params):
        with self._client:
            self.response = self._client.post("/v1/plans", params=params, content=body)

    def wait(self):
        self._thread.join(90)
        assert self.response is not None, "a push had no answer within 90 s"
        return self.response


def end_and_arm_again(rig, ending):
    """Send STOP or disarm, arm, and return the number of events that the board had logged between the two."""
    assert rig.client.post(f"/v1/{ending}").json()["board"]["state"] == "DISARMED"
    rig.tail.read()
    begin = len(rig.tail.events)
    rig.client.post("/v1/arm").raise_for_status()
    return begin


def find_light(rig, begin):
    """Return the edges to gate on that the board logged from index `begin` on."""
    rig.tail.read()
    return [event for event in rig.tail.events[begin:] if event["event"] == "gate" and event["on"]]


@pytest.mark.parametrize("ending", ["stop", "disarm"])
@pytest.mark.parametrize("attempt", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_a_large_push_from_before_never_lights(rig, ending, attempt):
    """400 full frames take seconds to plan; the end comes 0.3 s after they were sent."""
    rig.arm()
    push = Push(rig, build_full_frames(LARGE_FRAMES, PIXELS))
    time.sleep(0.3)
    begin = end_and_arm_again(rig, ending)
    response = push.wait()
    time.sleep(AFTER_S)
    light = find_light(rig, begin)
    rig.client.post("/v1/stop")
    assert not light, f"{len(light)} pulses, from {light[0]}"
    assert (response.status_code, response.json()["code"]) == (409, "stopped")


@pytest.mark.parametrize("ending", ["stop", pytest.param("disarm", marks=pytest.mark.slow)])
def test_a_small_push_behind_dry_runs_never_lights_afterwards(rig, ending):
    """It may have been planned and lit before the end."""
    rig.arm()
    body = build_full_frames(LARGE_FRAMES, PIXELS)
    runs = [Push(rig, body, dry_run=True) for _ in range(2)]
    time.sleep(0.1)
    push = Push(rig, SMALL)
    time.sleep(0.1)
    begin = end_and_arm_again(rig, ending)
    push.wait()
    time.sleep(AFTER_S)
    light = find_light(rig, begin)
    rig.client.post("/v1/stop")
    assert not light, f"{len(light)} pulses, from {light[0]}"
    for run in runs:
        assert run.wait().status_code in (200, 503)


def test_a_push_whose_body_began_before_never_lights(rig):
    """The head of the request and half of its body arrive before STOP, the rest after arming."""
    rig.arm()
    base = rig.client.base_url
    head = f"POST /v1/plans HTTP/1.1\r\nHost: {base.host}\r\nContent-Length: {len(SMALL)}\r\n"
    head += f"Authorization: {rig.client.headers['Authorization']}\r\n\r\n"
    with socket.create_connection((base.host, base.port), timeout=20) as link:
        link.sendall(head.encode() + SMALL[:40])
        time.sleep(0.2)
        begin = end_and_arm_again(rig, "stop")
        link.sendall(SMALL[40:])
        answer = link.recv(65536).decode()
    time.sleep(AFTER_S)
    light = find_light(rig, begin)
    rig.client.post("/v1/stop")
    assert not light, f"{len(light)} pulses, from {light[0]}"
    assert answer.startswith("HTTP/1.1 409 ")


def test_a_push_after_arming_again_lights(rig):
    """The judgement above would otherwise hold for a daemon that never lights."""
    rig.arm()
    begin = end_and_arm_again(rig, "stop")
    rig.client.post("/v1/plans", content=SMALL).raise_for_status()
    rig.tail.find(lambda event: event["event"] == "pulse", begin, "light")
    rig.client.post("/v1/stop")
