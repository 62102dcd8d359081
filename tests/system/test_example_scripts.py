"""The example scripts of studies: one with the client alone, and one for PsychoPy, which is not installed here."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from board_fixtures import board_disarmed, daemon_disarmed  # noqa: F401 - fixtures
from rig import TOKEN

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
ANSWERS = ["left", "up", "left", "down", "right", "right", "up", "down"]
STAND_IN = '''
"""The calls of PsychoPy that the script makes, as its documentation states them. Keys come at once."""
import time
from types import SimpleNamespace

class Clock:
    def __init__(self):
        self.zero_s = time.monotonic()
    def getTime(self):
        return time.monotonic() - self.zero_s

class Window:
    def __init__(self, *, fullscr, color):
        print("open")
    def flip(self):
        print("flip")
    def close(self):
        print("close")

class TextStim:
    def __init__(self, win, text, height):
        self.text = text
    def draw(self):
        print("draw", self.text.splitlines()[:1])

KEYS = iter({keys})

def wait_keys(*, keyList, timeStamped):
    name = next(KEYS)
    assert name in keyList
    return [(name, timeStamped.getTime())]

core = SimpleNamespace(Clock=Clock, wait=time.sleep)
event = SimpleNamespace(waitKeys=wait_keys)
visual = SimpleNamespace(Window=Window, TextStim=TextStim)
'''


@pytest.fixture
def run_script(daemon, tmp_path):
    """Return a function that runs a script on the daemon and returns its end."""

    def run(name, *arguments, text=""):
        environment = {"OPTODRIVE_TOKEN": TOKEN, "OPTODRIVE_URL": daemon.url, "PYTHONPATH": str(tmp_path)}
        return subprocess.run(
            [sys.executable, EXAMPLES / name, *arguments],
            input=text,
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={**os.environ, **environment},
        )

    return run


def read_table(folder):
    head, *rows = [line.split("\t") for line in (folder / "answers.tsv").read_text().splitlines()]
    assert head == ["trial", "direction", "answer", "response_time_s"]
    return rows


def assert_dark(board, daemon):
    assert daemon.board_state() == "DISARMED"
    assert board.of("gate")[-1]["on"] is False


def check_table(rows, answers):
    assert [row[0] for row in rows] == [str(number) for number in range(1, len(answers) + 1)]
    assert [row[2] for row in rows] == answers
    assert all(float(row[3]) > 0.0 for row in rows)


@pytest.mark.slow
def test_the_script_with_the_client_alone_runs_a_study(run_script, board, daemon, tmp_path):
    done = run_script("short_study.py", "answers.tsv", text="".join(f"{answer}\n" for answer in ["x", *ANSWERS]))
    assert done.returncode == 0, done.stderr
    assert "'x' is none of left, right, up, down" in done.stdout
    rows = read_table(tmp_path)
    check_table(rows, ANSWERS)
    assert sorted(row[1] for row in rows) == sorted(["left", "right", "up", "down"] * 2)
    assert board.of("pulse")
    assert_dark(board, daemon)


def test_a_table_that_exists_is_kept(run_script, board, tmp_path):
    (tmp_path / "answers.tsv").write_text("answers")
    done = run_script("short_study.py", "answers.tsv")
    assert (done.returncode, done.stderr) == (1, "short_study: [Errno 17] File exists: 'answers.tsv'\n")
    assert (tmp_path / "answers.tsv").read_text() == "answers"
    assert not board.of("pulse")


def test_a_study_that_is_left_keeps_its_trials_and_ends_dark(run_script, board, daemon, tmp_path):
    done = run_script("short_study.py", "answers.tsv", text="left\n")
    assert (done.returncode, done.stderr) == (1, "answer: no line; the table holds the trials so far\n")
    check_table(read_table(tmp_path), ["left"])
    assert_dark(board, daemon)


def test_without_psychopy_one_line_says_so(run_script, tmp_path):
    done = run_script("psychopy_study.py", "answers.tsv")
    assert done.returncode == 1
    assert done.stderr == "psychopy: missing, expected in this environment: pip install psychopy\n"
    assert not (tmp_path / "answers.tsv").exists()


@pytest.mark.slow
def test_the_script_for_psychopy_runs_with_the_calls_that_it_makes(run_script, board, daemon, tmp_path):
    (tmp_path / "psychopy.py").write_text(STAND_IN.format(keys=ANSWERS))
    done = run_script("psychopy_study.py", "answers.tsv")
    assert done.returncode == 0, done.stderr
    check_table(read_table(tmp_path), ANSWERS)
    assert done.stdout.splitlines()[0] == "open"
    assert done.stdout.splitlines()[-1] == "close"
    assert_dark(board, daemon)


def test_escape_ends_the_study_for_psychopy_dark(run_script, board, daemon, tmp_path):
    (tmp_path / "psychopy.py").write_text(STAND_IN.format(keys=["left", "escape"]))
    done = run_script("psychopy_study.py", "answers.tsv")
    assert done.returncode == 0, done.stderr
    check_table(read_table(tmp_path), ["left"])
    assert done.stdout.splitlines()[-1] == "close"
    assert_dark(board, daemon)
