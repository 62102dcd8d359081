"""kill -9 at random moments of a study, of its daemon, and of both: no trial is lost or doubled."""

import copy
import os
import random
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from forked_process import OPTODRIVE, start_process
from rig import TOKEN, wait_for
from study_rig import TRIALS, assert_on_the_board, find_defects, read_records, write_study

KILLS_MAX = 3
SESSIONS = [*range(8), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(8, 100))]
VALIDATOR = Path(sys.executable).with_name("bids-validator-deno")


def start_study(folder, *arguments, **options):
    command = [OPTODRIVE, "study", write_study(folder), "--out", folder / "data", *arguments]
    return start_process(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def log_path(folder, participant="sim01"):
    return folder / f"data/sourcedata/sub-{participant}/sub-{participant}_task-short_trials.jsonl"


def has_reached(process, path, size):
    """Return whether a log has a size, or its process has ended before."""
    return process.poll() is not None or (path.exists() and path.stat().st_size >= size)


@pytest.fixture(scope="module")
def whole_size(tmp_path_factory):
    """Size of the log of a session without an interruption, bytes."""
    folder = tmp_path_factory.mktemp("whole")
    process = start_study(folder)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert find_defects(read_records(log_path(folder))) == []
    return log_path(folder).stat().st_size


@pytest.mark.parametrize("seed", SESSIONS)
def test_a_study_killed_at_random_moments_has_every_trial_once(tmp_path, whole_size, seed):
    rng, path = random.Random(seed), log_path(tmp_path)
    for _ in range(rng.randint(1, KILLS_MAX)):
        process = start_study(tmp_path)
        wait_for(partial(has_reached, process, path, rng.randrange(whole_size)), "the moment", rng.uniform(0.0, 0.005))
        process.kill()
        process.communicate()
    process = start_study(tmp_path)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    records = read_records(path)
    assert find_defects(records) == []
    assert sum(record["record"] == "trial" for record in records) == TRIALS
    table = (tmp_path / "data/sub-sim01/beh/sub-sim01_task-short_beh.tsv").read_text().splitlines()
    assert len(table) == 1 + TRIALS
    assert subprocess.run([VALIDATOR, tmp_path / "data"], capture_output=True).returncode == 0


def lose(records):
    del records[max(k for k, record in enumerate(records) if record["record"] == "trial")]


def double(records):
    records += records[-2:]


def distort(records):
    records[-1]["presentations"][0]["executed"]["width_s"][3] += 2e-4


def drop_pulse(records):
    for column in records[-1]["presentations"][0]["executed"].values():
        del column[-1]


def leave_unmarked(records):
    records.insert(-2, copy.deepcopy(records[-2]))


@pytest.mark.parametrize("change", [lose, double, distort, drop_pulse, leave_unmarked])
def test_the_check_finds_a_defect(tmp_path, change):
    start_study(tmp_path).communicate()
    records = read_records(log_path(tmp_path))
    assert find_defects(records) == []
    change(records)
    assert find_defects(records)


class Person:
    """A participant's terminal: answers every question of the process with the first answer."""

    def __init__(self, folder, daemon):
        self.process = start_study(
            folder,
            *("--participant", "07", "--hold", "--url", daemon.url),
            stdin=subprocess.PIPE,
            env={**os.environ, "OPTODRIVE_TOKEN": TOKEN, "XDG_RUNTIME_DIR": str(folder)},
        )
        self.process.stdin.write("2-3\n" * TRIALS)
        self.process.stdin.flush()

    def end(self):
        """Wait for the end of the process and return its status. An error is one line."""
        _, errors = self.process.communicate()
        assert "Traceback" not in errors
        return self.process.returncode

    def kill(self):
        self.process.kill()
        self.process.communicate()


def start_until_light(folder, daemon, board, path, begun):
    """Start a person's run, once more if it ends early, until a number of trials were begun and light is seen."""
    while True:
        person = Person(folder, daemon)
        pulses = len(board.of("pulse"))

        def is_light_seen():
            trials = sum(record["record"] == "begun" for record in read_records(path))
            return trials >= begun and len(board.of("pulse")) > pulses  # noqa: B023 - called in this round

        wait_for(lambda: is_light_seen() or person.process.poll() is not None, "light")  # noqa: B023
        if person.process.poll() is None:
            return person
        assert person.end() != 0


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 10))])
@pytest.mark.parametrize("victim", ["study", "daemon", "link"])
def test_a_persons_session_goes_on_after_a_kill(tmp_path, board, make_daemon, victim, seed):
    rng, path = random.Random(seed), log_path(tmp_path, "07")
    daemon = make_daemon(board)
    person = start_until_light(tmp_path, daemon, board, path, begun=rng.randrange(1, 4))
    if victim == "study":
        person.kill()
        wait_for(lambda: daemon.board_state() == "DISARMED", "disarmed")
    else:
        pid = daemon.process.pid if victim == "daemon" else daemon.find_process("link")
        os.kill(pid, signal.SIGKILL)
        assert person.end() != 0
    wait_for(lambda: board.of("state")[-1]["state"] == "DISARMED", "disarmed")
    assert board.of("gate")[-1]["on"] is False
    if victim != "study":
        daemon.stop()
        daemon = make_daemon(board)
    while Person(tmp_path, daemon).end() != 0:  # a computer that stalls for a second ends the arming, and so a run
        wait_for(lambda: daemon.board_state() == "DISARMED", "disarmed")
    records = read_records(path)
    assert find_defects(records) == []
    assert any(record["record"] in ("interrupted", "spoiled") for record in records)
    logged = [(pulse["on_us"], pulse["off_us"]) for pulse in board.all_of("pulse")]
    for record in records:
        if record["record"] == "trial":
            assert_on_the_board(record["presentations"][-1], logged)
    head, *rows = [line.split("\t") for line in next(tmp_path.glob("data/sub-07/beh/*.tsv")).read_text().splitlines()]
    for row in rows:
        cells = dict(zip(head, row, strict=True))
        assert float(cells["requested_onset"]) == pytest.approx(float(cells["stimulus_onset"]), abs=2e-3)
        assert float(cells["requested_duration"]) == pytest.approx(float(cells["stimulus_duration"]), abs=4e-6)
        assert float(cells["stimulus_height"]) > 50.0
        assert cells["correct_answer"] == cells["digits"]
