"""The emulated Cortex-M3 as a process under a daemon.

tests/firmware judges its times, in its own time.
"""

import pytest

from firmware_ports import build_board
from rig import running, wait_for
from test_six_experiments import cell_codes


@pytest.fixture
def bench(tmp_path):
    with running(tmp_path, program=build_board(tmp_path / "build", port="mps2-an385")) as (board, daemon):
        daemon.arm()
        yield board, daemon


def test_an_experiment_is_executed_in_order_and_stop_disarms(bench):
    """A computer too slow for the chip's time ends the lease, and with it the plan; nothing else may differ."""
    board, daemon = bench
    answer = daemon.finished(daemon.call("POST", "/v1/patterns/experiment-6", json={"digits": "2-3"})["plan"])
    daemon.call("POST", "/v1/stop")
    wait_for(lambda: board.of("state")[-1]["state"] in ("DISARMED", "FAULT"), "the end of permission to emit")
    pulses, faults = board.of("pulse"), {fault["fault"] for fault in board.of("fault")}
    assert answer["planned"] == 40
    assert [[pulse["x"], pulse["y"]] for pulse in pulses] == cell_codes()[
        answer["pulses"]["pixel"][: len(pulses)]
    ].tolist()
    assert [edge["on"] for edge in board.of("pin")] == [True, False] * len(pulses)
    assert faults <= {"LINK"}
    assert answer["executed"] <= len(pulses)
    if answer["status"] == "done" and not faults:
        assert answer["executed"] == len(pulses) == 40
    else:
        assert faults or answer["error"]
