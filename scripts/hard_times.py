"""Run a command on a computer made bad on purpose: processors busy, and random processes frozen.

Two busy loops compete for the processors. About twice per second a random process below the command freezes for 50 to
300 ms; the test runner and its workers go on, because their stalls would only delay the judge. A test that fails here
states something about the computer, not about the program.

A process is frozen by ptrace(2), not by SIGSTOP: tests suspend processes by SIGSTOP themselves, and the SIGCONT that
ended a freeze would resume theirs. A frozen process still ends by SIGKILL, and keeps a SIGSTOP that it received.
Requires Linux on a 64-bit processor, and the same user for all processes.
"""

import argparse
import ctypes
import os
import random
import re
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

BUSY_LOOPS = 2
BUSY_LOOP = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"
FREEZE_S = (0.05, 0.3)
GAP_S = (0.1, 0.55)
"""From the end of a freeze to the next one: with the mean freeze, two per second."""
LIVE = ("tests/system", "tests/browser", "tests/conformance", "tests/docs")
WORKER = "import sys;exec(eval(sys.stdin.readline()))"
"""Program of a worker of xdist."""
PTRACE_SEIZE, PTRACE_INTERRUPT, PTRACE_DETACH, WALL = 0x4206, 0x4207, 17, 0x40000000
EVENT_STOP = 128
libc = ctypes.CDLL(None, use_errno=True)
libc.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]


def read_proc(pid, name):
    """Return the text of a file of a process in /proc, empty if the process has ended."""
    try:
        return Path(f"/proc/{pid}/{name}").read_text(errors="replace")
    except OSError:
        return ""


def list_threads(pid):
    """Return the threads of a process, none if it has ended."""
    try:
        return sorted(int(path.name) for path in Path(f"/proc/{pid}/task").iterdir())
    except OSError:
        return []


def list_descendants(pid):
    """Return the process ids below a process."""
    found = []
    for thread in list_threads(pid):
        for child in map(int, read_proc(pid, f"task/{thread}/children").split()):
            found += [child, *list_descendants(child)]
    return found


def can_freeze(pid):
    """Return whether a process is not the test runner and is neither suspended nor ended."""
    arguments = read_proc(pid, "cmdline").split("\0")
    is_runner = WORKER in arguments or "pytest" in (Path(argument).name for argument in arguments[:4])
    state = read_proc(pid, "stat").rpartition(")")[2].split()[:1]
    return state in (["R"], ["S"]) and not is_runner


def freeze(pid, duration_s):
    """Freeze all threads of a process for a time."""
    frozen = []
    for thread in list_threads(pid):
        if libc.ptrace(PTRACE_SEIZE, thread, None, None) == 0:
            libc.ptrace(PTRACE_INTERRUPT, thread, None, None)
            frozen.append(thread)
    signals = {}
    for thread in reversed(frozen):  # the first thread of a process that was killed ends last
        with suppress(ChildProcessError):
            _, status = os.waitpid(thread, WALL)
            if os.WIFSTOPPED(status):  # a signal that arrived first is handed on at the end
                signals[thread] = 0 if status >> 16 == EVENT_STOP else os.WSTOPSIG(status)
    time.sleep(duration_s)
    for thread, number in signals.items():
        if libc.ptrace(PTRACE_DETACH, thread, None, number) != 0:  # killed meanwhile: its parent waits for this wait
            with suppress(ChildProcessError):
                os.waitpid(thread, WALL)


def run(command, source):
    """Run a command among busy loops and freezes, and return its status."""
    loops = [subprocess.Popen([sys.executable, "-c", BUSY_LOOP]) for _ in range(BUSY_LOOPS)]
    count = 0
    try:
        process = subprocess.Popen(command)
        while process.poll() is None:
            candidates = list(filter(can_freeze, list_descendants(process.pid)))
            if candidates:
                freeze(source.choice(candidates), source.uniform(*FREEZE_S))
                count += 1
            time.sleep(source.uniform(*GAP_S))
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
    print(f"hard-times: {count} freezes", file=sys.stderr)
    return process.returncode


def list_live_tests(part, parts):
    """Return one part of the files with tests in real time."""
    files = sorted(str(path) for folder in LIVE for path in Path(folder).glob("test_*.py"))
    return files[part - 1 :: parts]


def parse_part(text):
    """Return K and M of K/M."""
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected K/M with K from 1 to M")
    return int(match[1]), int(match[2])


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=0, help="of the freezes")
    parser.add_argument("--part", type=parse_part, default=(1, 1), metavar="K/M", help="of the files, without COMMAND")
    parser.add_argument("command", nargs=argparse.REMAINDER, help="by default pytest on the tests in real time")
    options = parser.parse_args()
    pytest = [
        sys.executable,
        "-m",
        "pytest",
        "-m",
        "not slow",
        "-n",
        "4",
        "--dist",
        "loadfile",
        "--no-loadscope-reorder",
    ]
    return run(options.command or [*pytest, *list_live_tests(*options.part)], random.Random(options.seed))


if __name__ == "__main__":
    sys.exit(main())
