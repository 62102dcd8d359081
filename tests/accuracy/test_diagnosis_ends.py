"""A diagnosis on processes ends or goes on when a process is killed, suspended or interrupted, and leaves nothing."""

import os
import signal
import subprocess
import sys

import pytest

from display_lab import display_lab
from optodrive.core.types.measurements import Measurement
from optodrive.lab.diagnosis.display_diagnosis import run_tasks
from optodrive.lab.recording import write_recording
from rig import OPTODRIVE, is_alive, read_proc, wait_for
from signalled_processes import SIGNALS, assert_one_line, signalling, wait_for_end

SCHEDULER = """
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None,
                      worker_dashboard_address=None) as cluster:
        print(cluster.scheduler_address, flush=True)
        input()
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("display") / "display.h5"
    pixels = {pixel: {} for pixel in range(20, 26)}
    runs = display_lab(pixels, groups=("weak", "middle", "strong"), repeats=2, rate=500.0).runs
    write_recording(path, Measurement(tuple(runs)))
    return path


@pytest.fixture
def start(recording, tmp_path):
    """Return a function that starts a diagnosis on two processes, as a process of its own."""
    started = []

    def start_diagnosis(*arguments):
        command = [OPTODRIVE, "diagnose", recording, "--out", tmp_path / "out", *arguments]
        started.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield start_diagnosis
    for process in started:
        process.kill()
        process.wait()
        process.stderr.close()


def list_children(pid):
    """Return the process ids of the children that a process has started, by any of its threads."""
    threads = os.listdir(f"/proc/{pid}/task") if is_alive(pid) else []  # noqa: PTH208
    return [int(child) for thread in threads for child in read_proc(pid, f"task/{thread}/children").split()]


def find_workers(pid):
    """Return the process ids of the workers that a process has started."""
    return [child for child in list_children(pid) if "spawn_main" in read_proc(child, "cmdline")]


def has_reached(stage, process):
    """Return whether both workers exist and, in the second stage, have imported the modules that a task needs."""
    workers = find_workers(process.pid)
    return len(workers) == 2 and (stage == "starting" or all("h5py" in read_proc(pid, "maps") for pid in workers))


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["starting", "computing"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_diagnosis_ends_with_its_processes(start, tmp_path, number, stage):
    process = start("--workers", "2")
    wait_for(lambda: has_reached(stage, process), stage)
    workers = find_workers(process.pid)
    process.send_signal(number)
    assert wait_for_end(process) == "optodrive: interrupted\n"
    assert process.returncode == 130
    wait_for(lambda: not any(map(is_alive, workers)), "the end of the workers")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
def test_the_others_do_the_work_of_a_worker_that_is_lost_at_the_start(start, tmp_path, number):
    process = start("--workers", "2")
    wait_for(lambda: has_reached("starting", process), "the workers")
    workers = find_workers(process.pid)
    os.kill(workers[0], number)
    wait_for_end(process)
    assert process.returncode == 0
    wait_for(lambda: not any(map(is_alive, workers)), "the end of the workers")
    assert (tmp_path / "out" / "report.html").exists()


def suspend_once(path):
    """Suspend the process of the first task that finds no file, for good."""
    if not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGSTOP)
    return os.getpid()


@pytest.mark.slow
def test_the_task_of_a_suspended_worker_runs_again(tmp_path):
    paths = [tmp_path / name for name in ("one", "two")]
    paths[1].touch()
    results = {task: (pid, error) for task, pid, error in run_tasks(suspend_once, paths, workers=2)}
    assert all(pid and not error for pid, error in results.values())


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
def test_a_lost_scheduler_ends_the_diagnosis(start, tmp_path, number):
    script = tmp_path / "scheduler.py"
    script.write_text(SCHEDULER)
    scheduler = subprocess.Popen(
        [sys.executable, script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        address = scheduler.stdout.readline().strip()
        workers = find_workers(scheduler.pid)
        process = start("--dask", address)
        with signalling() as send:
            wait_for(lambda: all("h5py" in read_proc(pid, "maps") for pid in workers), "the first task")
            assert process.poll() is None
            send(number, [scheduler.pid])
            errors = wait_for_end(process)
    finally:
        scheduler.kill()
        scheduler.communicate()
    assert "scheduler" in assert_one_line(errors)
    assert process.returncode == 1
    assert not (tmp_path / "out").exists()
