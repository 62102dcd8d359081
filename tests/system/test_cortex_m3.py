"""The emulated Cortex-M3 as a process under a daemon.

tests/firmware judges its times, in its own time.
"""

import pytest

from firmware_ports import build_board
from rig import running
from test_six_experiments import cell_codes


@pytest.fixture
def bench(tmp_path):
    with running(tmp_path, program=build_board(tmp_path / "build", port="mps2-an385")) as (board, daemon):
        daemon.arm()
        yield board, daemon


def test_an_experiment_is_executed_in_order_and_stop_disarms(bench):
    board, daemon = bench
    answer = daemon.finished(daemon.call("POST", "/v1/patterns/experiment-6", json={"digits": "2-3"})["plan"])
    assert answer["status"] == "done", answer["error"]
    assert answer["planned"] == answer["executed"] == 40
    assert answer["executed_complete"]
    pulses = board.of("pulse")
    assert [[pulse["x"], pulse["y"]] for pulse in pulses] == cell_codes()[answer["executed_pulses"]["pixel"]].tolist()
    assert [edge["on"] for edge in board.of("pin")] == [True, False] * 40
    assert not board.of("fault")
    daemon.call("POST", "/v1/stop")
    assert board.of("state")[-1]["state"] == "DISARMED"
