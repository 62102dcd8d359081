"""SIGINT and SIGTERM end every command that runs on, at any moment from its start on, and leave the board dark."""

import json
import os
import random
import signal
import subprocess
import time
from itertools import cycle

import pytest

from forked_process import FULL_INDICATOR, OPTODRIVE, start_process
from rig import TOKEN, Board, config_text, long_train, running, wait_for
from study_rig import write_study

SIGNALS = (signal.SIGINT, signal.SIGTERM)
START_MAX_S = 1.5
"""Most starts take less; later signals come while the command does what it is for."""
DRAWS = [2, pytest.param(40, marks=pytest.mark.slow)]
BY_DAEMON = {
    "fingers": ["fingers", "fingers.csv", "--repeat"],
    "braille": ["braille", "reader", "--hold"],
    "arm": ["arm", "--hold"],
    "push": ["push", "train.json", "--hold"],
    "study": ["study", "study.toml", "--out", "data", "--participant", "07", "--hold"],
    "study on a page": ["study", "study.toml", "--out", "data", "--participant", "07", "--hold", "--page", "0"],
}
BY_BOARD = {
    "serve": ["serve", "--port", "0"],
    "home": ["home"],
    "calibrate board": ["calibrate", "board", "--yes", "--manual", "--out", "field.toml"],
    "doctor": ["doctor", "--watch"],
}


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    with running(tmp_path_factory.mktemp("daemon")) as rig:
        yield rig


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fingers.csv").write_text(
        "time_s,number,x_m,y_m,radius_m\n" + "".join(f"{k / 100},1,0,0,0.004\n" for k in range(9))
    )
    (tmp_path / "train.json").write_text(json.dumps(long_train(seconds=300.0)))
    write_study(tmp_path).rename(tmp_path / "study.toml")
    return tmp_path


def end_at_a_drawn_moment(rng, number, arguments, environment):
    """Start a command, send it a signal after a drawn time, and wait for its end."""
    command = [OPTODRIVE, *arguments]
    with start_process(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        time.sleep(rng.uniform(0.0, START_MAX_S))
        process.send_signal(number)
        errors = process.stderr.read()
        status = process.wait()
    assert "Traceback" not in errors, errors
    assert status in (130, -number) or (arguments[0] == "serve" and status == 0), (status, errors)


def is_dark(board):
    states, gates = board.all_of("state"), board.all_of("gate")
    return (not states or states[-1]["state"] == "DISARMED") and not (gates and gates[-1]["on"])


@pytest.mark.parametrize("draws", DRAWS)
@pytest.mark.parametrize("name", BY_DAEMON)
def test_a_client_ends_and_the_board_is_dark(rig, folder, name, draws):
    board, daemon = rig
    rng, environment = random.Random(name), {**os.environ, "OPTODRIVE_TOKEN": TOKEN, "OPTODRIVE_URL": daemon.url}
    for _, number in zip(range(draws), cycle(SIGNALS), strict=False):
        end_at_a_drawn_moment(rng, number, BY_DAEMON[name], environment)
        wait_for(lambda: is_dark(board), "the board's end of light")


@pytest.mark.parametrize("draws", DRAWS)
@pytest.mark.parametrize("name", BY_BOARD)
def test_a_command_with_a_board_of_its_own_ends_and_the_board_is_dark(folder, name, draws):
    board = Board(folder, program=FULL_INDICATOR, sensor=())
    try:
        config = folder / "bench.toml"
        config.write_text(config_text(board.port, sensor=board.sensor))
        environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN, "XDG_RUNTIME_DIR": str(folder)}
        rng = random.Random(name)
        for _, number in zip(range(draws), cycle(SIGNALS), strict=False):
            end_at_a_drawn_moment(rng, number, [*BY_BOARD[name], "--config", str(config)], environment)
            wait_for(lambda: is_dark(board), "the board's end of light")
    finally:
        board.stop()
