"""Reported latencies against the board's own log and the caller's own instants, however long they take."""

import json
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from websockets.sync.client import connect

from optodrive.client import Display
from optodrive.link.session.clock_sync import CLOCK_SPAN_S, DRIFT_MAX
from rig import TOKEN

FRAMES = 12
EVENTS = ("planned", "first_byte", "first_light")


class Exchange:
    """One frame of one pixel: the caller's instants before and after sending it, that of the answer, and the reports.

    planned_s: latency stated by the answer; executed: number of pulses; latency: of the final report
    """

    def __init__(self, frame):
        self.frame = frame
        self.executed, self.latency = 0, None

    @contextmanager
    def sending(self):
        self.before_s = time.monotonic()
        yield
        self.after_s = time.monotonic()

    def answered(self, latency):
        self.answered_s = time.monotonic()
        self.planned_s = latency["planned_s"]

    def ended(self, report):
        self.executed, self.latency = report["executed"], report["latency"]


def over_socket(daemon, exchanges):
    url, bearer = daemon.url.replace("http", "ws"), {"Authorization": f"Bearer {TOKEN}"}
    with connect(f"{url}/v1/stream", additional_headers=bearer, proxy=None) as stream:

        def receive(status, number):
            while True:
                result = json.loads(stream.recv())
                exchange = exchanges[result["frame"]]
                if result["status"] == "planned":
                    exchange.answered(result["latency"])
                else:
                    exchange.ended(result)
                if exchange is exchanges[number] and (result["status"] == "planned") == (status == "planned"):
                    return

        for number, exchange in enumerate(exchanges):
            with exchange.sending():
                stream.send(json.dumps(exchange.frame))
            receive("planned", number)
        receive("ended", -1)


def over_rest(daemon, exchanges):
    plans = []
    for exchange in exchanges:
        body = {"frames": [{"show_at_s": 0, "duration_s": 1, **exchange.frame}]}
        with exchange.sending():
            answer = daemon.call("POST", "/v1/plans?newest=true", json=body)
        exchange.answered(answer["latency"])
        plans.append(answer["plan"])
    for exchange, plan in zip(exchanges, plans, strict=True):
        exchange.ended(daemon.finished(plan))


def over_client(daemon, exchanges):
    with Display(daemon.url, TOKEN) as display, display.stream() as stream:
        for exchange in exchanges:
            with exchange.sending():
                stream.send({int(pixel): height_um for pixel, height_um in exchange.frame["target_um"].items()})
            while not (planned := [each for each in stream.results() if each.status == "planned"]):
                time.sleep(0.0005)
            exchange.answered(planned[-1].latency.model_dump())
        for number, exchange in enumerate(exchanges):
            exchange.ended(stream.wait(number).model_dump())


def clip(value, low, high):
    """Return the value of an interval that is next to a value."""
    return min(max(value, low), high)


@pytest.mark.parametrize("show", [over_socket, over_rest, over_client])
def test_a_latency_lies_between_the_instants_of_caller_and_board(disarmed, show):
    """Each frame is sent as soon as the one before is planned. A few are superseded before their light."""
    board, daemon = disarmed
    daemon.arm()
    exchanges = [Exchange({"target_um": {str(100 + 3 * number): 60}}) for number in range(FRAMES)]
    show(daemon, exchanges)
    zero_s = float(Path(f"{board.port}.clock").read_text())
    lights_s = [zero_s + event["t_us"] * 1e-6 for event in board.of("gate") if event["on"]]
    shown = [exchange for exchange in exchanges if exchange.executed]
    assert shown[-1] is exchanges[-1]
    error_s = 0.5 * (1e-3 * daemon.state()["link"]["round_trip_ms"] + DRIFT_MAX * CLOCK_SPAN_S)
    for exchange, light_s in zip(shown, lights_s, strict=True):
        planned_s, first_byte_s, first_light_s = (exchange.latency[f"{name}_s"] for name in EVENTS)
        assert 0 < planned_s == exchange.planned_s < first_byte_s < first_light_s
        arrived_s = light_s - first_light_s
        assert arrived_s == pytest.approx(clip(arrived_s, exchange.before_s, exchange.after_s), abs=error_s)
        accepted_s = arrived_s + planned_s
        assert accepted_s == pytest.approx(clip(accepted_s, arrived_s, exchange.answered_s), abs=error_s)
