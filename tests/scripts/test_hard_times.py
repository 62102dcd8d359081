"""A process that hard times freeze goes on as if nothing had happened, and obeys the signals that it received."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "scripts"))

import hard_times

THREADS = """
import threading, time
for _ in range(3):
    threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
print("ready", flush=True)
time.sleep(60)
"""
FREEZE = f"""
import sys
sys.path.append({str(Path(hard_times.__file__).parent)!r})
import hard_times
hard_times.time.sleep = lambda _: sys.stdin.read()
hard_times.freeze(int(sys.argv[1]), 0.3)
"""

LATE = "os.waitpid = lambda *arguments: (sys.stdin.read(), wait(*arguments))[1]"
"""Waits for a thread only after its standard input has ended."""


def read_states(process):
    """Return the states of a process's threads: t of a frozen one, T of a suspended one."""
    tasks = Path(f"/proc/{process.pid}/task").glob("*/stat")
    return {path.read_text().rpartition(")")[2].split()[0] for path in tasks}


def wait_for_states(process, states):
    while read_states(process) != states:
        pass


@pytest.fixture
def process():
    process = subprocess.Popen([sys.executable, "-c", THREADS], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


@pytest.fixture
def frozen(process):
    """Yield a process that another one has frozen, and a function that ends the freeze and returns then."""
    freezing = subprocess.Popen([sys.executable, "-c", FREEZE, str(process.pid)], stdin=subprocess.PIPE)
    wait_for_states(process, {"t"})

    def release():
        freezing.stdin.close()
        freezing.wait()

    yield process, release
    release()


def test_all_threads_freeze_and_go_on(frozen):
    process, release = frozen
    assert not hard_times.can_freeze(process.pid)
    release()
    wait_for_states(process, {"S"})
    assert hard_times.can_freeze(process.pid)


def test_a_frozen_process_stays_suspended_if_a_test_suspended_it(frozen):
    process, release = frozen
    process.send_signal(signal.SIGSTOP)
    release()
    wait_for_states(process, {"T"})
    assert not hard_times.can_freeze(process.pid)
    process.send_signal(signal.SIGCONT)
    wait_for_states(process, {"S"})


def test_a_frozen_process_can_be_killed(frozen):
    process, release = frozen
    process.kill()
    release()
    assert process.wait() == -signal.SIGKILL


def test_a_process_that_is_killed_before_its_freeze_is_awaited_ends_it(process):
    late = FREEZE.replace("import hard_times", "import os, hard_times\nwait = os.waitpid\n" + LATE, 1)
    freezing = subprocess.Popen([sys.executable, "-c", late, str(process.pid)], stdin=subprocess.PIPE)
    wait_for_states(process, {"t"})
    process.kill()
    freezing.stdin.close()
    assert freezing.wait() == 0


def test_the_status_is_that_of_the_command():
    script = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import time; time.sleep(1)']); sys.exit(7)"
    done = subprocess.run([sys.executable, hard_times.__file__, "--seed", "1", sys.executable, "-c", script])
    assert done.returncode == 7
