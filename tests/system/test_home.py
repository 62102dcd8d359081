"""`optodrive home` on a board process: results, refusals and exits with the gate off."""

import json
import signal
from functools import partial

import pytest

from forked_process import FULL_INDICATOR
from optodrive.lab.commissioning.exclusive_board import SPOT_POWER_MAX_W
from optodrive.link.simulator.guards import DEFAULT_LIMITS
from rig import wait_for
from signalled_processes import assert_dark_within_lease

STEPS = ["link", "status", "inputs", "indicator", "zero", "travel x", "travel y", "readback", "zero again"]


@pytest.fixture(name="make_board")
def make_board_with_full_indicator(make_board):
    """`home` measures the indicator."""
    return partial(make_board, program=FULL_INDICATOR)


def assert_dark(board, states=("DISARMED",)):
    wait_for(lambda: board.of("state")[-1]["state"] in states, f"the board to be {states}")
    gates = board.of("gate")
    assert not gates or gates[-1]["on"] is False
    return board


def step_of(at_s, kind, value):
    return f'[[step]]\nat_s = {at_s}\n{kind} = "{value}"\n'


def test_without_emission(make_board, start):
    board = make_board(sensor=())
    status, out, errors = start(board, "home", "--json").ended()
    assert status == 0, errors
    answer = json.loads(out)
    assert answer["home"] is True
    assert answer["failure"] is None
    assert [step["step"] for step in answer["steps"]] == STEPS
    assert not assert_dark(board).of("gate")
    assert answer["steps"][3]["indicator_s"] >= 2.0
    states = [event["state"] for event in board.of("state")]
    assert states[:3] == ["DISARMED", "ARMING", "ARMED"]
    assert states[-1] == "DISARMED"


def test_with_a_spot_and_no_position_outputs(make_board, start):
    board = make_board(sensor=("--no-readback", "--outlier-share", "0.1"))
    status, out, errors = start(board, "home", "--spot-power-mw", "5").ended()
    assert status == 0, errors
    assert "no position outputs: not checked" in out
    assert "observed by spot" in out
    pulses = assert_dark(board).of("pulse")
    assert len(pulses) == 15
    assert (
        max(pulse["duty"] for pulse in pulses) / 65535 * DEFAULT_LIMITS.full_power_uw * 1e-6 <= 5e-3 < SPOT_POWER_MAX_W
    )


def test_without_a_sensor_the_mirrors_are_not_observed(board, start):
    status, out, errors = start(board, "home").ended()
    assert status == 0, errors
    assert "no sensor" in out
    assert "no instrument observes the mirrors" in out
    assert not assert_dark(board).of("gate")


@pytest.mark.parametrize(
    ("script", "arguments", "says"),
    [
        pytest.param(
            *("stick_x", (), "home: travel x: mirror x, commanded 0.1636 rad from end to end,: got does not move"),
            marks=pytest.mark.slow,
        ),
        (
            "stick_y",
            ("--spot-power-mw", "5"),
            "home: travel y: mirror y, commanded 0.1636 rad from end to end,: got does not move",
        ),
        pytest.param("invert_readback", (), "rad, inverted, expected 0.16364 ±", marks=pytest.mark.slow),
        pytest.param(
            *("blind_sensor", ("--spot-power-mw", "5"), "got no spot, expected a spot: is it covered"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_defect_is_named(make_board, start, script, arguments, says):
    board = make_board(sensor=(), script=step_of(0.0, "do", script))
    status, _, errors = start(board, "home", *arguments).ended()
    assert status == 1
    assert says in errors
    assert errors.count("\n") == 1
    assert_dark(board)


def armed(board):
    wait_for(lambda: board.of("state") and board.of("state")[-1]["state"] in ("ARMED", "RUNNING"), "ARMED")


@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM, signal.SIGKILL]
)
def test_a_signal_ends_it(make_board, start, number):
    board = make_board(sensor=())
    command = start(board, "home", "--spot-power-mw", "5")
    armed(board)
    command.process.send_signal(number)
    status, _, errors = command.ended()
    assert_dark(board, ("DISARMED", "FAULT"))
    if number == signal.SIGKILL:
        assert_dark_within_lease(board)
    else:
        assert status == 130
        assert errors == "optodrive: interrupted\n"
        assert board.of("state")[-1]["reason"] in ("abort", "link lost")


def test_a_board_in_use_by_a_daemon(board, daemon, start):
    status, _, errors = start(board, "home").ended()
    assert status == 1
    assert "optodrive serve" in errors
    assert daemon.board_state() == "DISARMED"


def test_a_missing_sensor(make_board, start):
    board = make_board(sensor=(), script=step_of(0.0, "do", "unplug_sensor"))
    wait_for(lambda: not board.sensor.exists(), "the sensor to be gone")
    status, _, errors = start(board, "home").ended()
    assert status == 2
    assert "sensor.port" in errors
    assert_dark(board)
