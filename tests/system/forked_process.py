"""`optodrive` commands and simulated boards as forks of a server that has loaded them.

See fork_server.py.
"""

import json
import os
import resource
import select
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import fork_server

OPTODRIVE = Path(sys.executable).with_name("optodrive")
SIMULATED = (sys.executable, "-m", "optodrive.link.simulator.board_process")
SHORT_INDICATOR = (sys.executable, str(Path(__file__).with_name("short_indicator_board.py")))
FULL_INDICATOR = (*SHORT_INDICATOR, "--full-indicator")
LONG_INDICATOR = (*SHORT_INDICATOR, "--long-indicator")
PROGRAMS = {(str(OPTODRIVE),): "optodrive", SIMULATED: "board", SHORT_INDICATOR: "short_indicator_board"}
LOADED_VARIABLES = ("HOME", "LD_", "NUMBA_", "OPENBLAS_", "PYTHON", "XDG_CACHE_HOME")
"""Beginnings of the variables that a process reads while it loads: with others than the server's, it starts anew."""
IRRELEVANT = "PYTHONHASHSEED"
"""A variable that Dask leaves behind, and that changes no result."""
_server = None


def enable():
    """Let processes of this process be forks from now on. Scripts that measure a daemon do not."""
    global _server
    _server = _Server()


def disable():
    global _server
    if _server is not None:
        _server.close()
    _server = None


class _Server:
    """Fork server, which starts with the first request."""

    def __init__(self):
        self.environment = dict(os.environ)
        self._control = None
        self._lock = threading.Lock()

    def request(self, fields, descriptors):
        with self._lock:
            if self._control is None:
                self._start()
        socket.send_fds(self._control, [json.dumps(fields).encode()], descriptors)

    def _start(self):
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            number = theirs.fileno()
            command = [sys.executable, fork_server.__file__, str(number)]
            self._process = subprocess.Popen(command, pass_fds=[number], env=self.environment)

    def close(self):
        if self._control is not None:
            self._control.close()
            self._process.wait()


class Process(subprocess.Popen):
    """A Popen whose block waits for the end of the process only if it succeeds, and else kills it."""

    def __exit__(self, kind, error, trace):
        if kind is not None:
            self.kill()
        super().__exit__(kind, error, trace)


def start_process(command, **options):
    """Start a command as subprocess.Popen does: as a fork if the server runs and knows the program."""
    command = list(map(str, command))
    program, arguments = _find_program(command)
    if program is None or not _is_forkable(options):
        return Process(command, **options)
    return ForkedProcess(program, arguments, **options)


def run_process(command, input=None, timeout=None, check=False, capture_output=False, **options):
    """Run a command to its end as subprocess.run does."""
    if capture_output:
        options |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    if input is not None:
        options["stdin"] = subprocess.PIPE
    with start_process(command, **options) as process:
        out, errors = process.communicate(input, timeout)
    done = subprocess.CompletedProcess(command, process.returncode, out, errors)
    if check:
        done.check_returncode()
    return done


def _find_program(command):
    for start, program in PROGRAMS.items():
        if tuple(command[: len(start)]) == start:
            return program, command[len(start) :]
    return None, []


def _is_forkable(options):
    if _server is None or set(options) - {"stdin", "stdout", "stderr", "env", "cwd", "text"}:
        return False
    environment = options.get("env") or os.environ
    names = {*environment, *_server.environment}
    return not any(
        name.startswith(LOADED_VARIABLES) and environment.get(name) != _server.environment.get(name)
        for name in names - {IRRELEVANT}
    )


class ForkedProcess(Process):
    """A Process that is a child of the fork server, which reports its end."""

    def __init__(self, program, arguments, **options):
        self._status, self._received = None, b""
        super().__init__([program, *arguments], **options)

    def _execute_child(
        self, command, _executable, _preexec, _close, _pass, cwd, env, _info, _flags, _shell, *handles_and_more
    ):
        handles = handles_and_more[:6]
        inherited = enumerate((handles[0], handles[3], handles[5]))
        self._status, theirs = socket.socketpair()
        with theirs:
            fields = {
                "program": command[0],
                "arguments": command[1:],
                "folder": str(cwd or Path.cwd()),
                "environment": dict(os.environ if env is None else env),
                "limits": [(limit, resource.getrlimit(limit)) for limit in fork_server.RLIMITS],
            }
            descriptors = [number if given == -1 else given for number, given in inherited]
            _server.request(fields, [*descriptors, theirs.fileno()])
        self._receive(1, None)
        self.pid = int(self._received.split()[0])
        self._child_created = True
        self._close_pipe_fds(*handles)

    def _receive(self, lines, timeout_s):
        """Receive until this number of lines has arrived or the time is over."""
        until_s = None if timeout_s is None else time.monotonic() + timeout_s
        while self._received.count(b"\n") < lines:
            wait_s = None if until_s is None else max(0.0, until_s - time.monotonic())
            if not select.select([self._status], [], [], wait_s)[0]:
                return
            data = self._status.recv(100)
            assert data, "the fork server has ended"
            self._received += data

    def _wait(self, timeout):
        if self.returncode is None:
            with self._waitpid_lock:
                self._look(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self.args, timeout)
        return self.returncode

    def _internal_poll(self, _deadstate=None):
        if self.returncode is None and self._waitpid_lock.acquire(False):
            try:
                self._look(0.0)
            finally:
                self._waitpid_lock.release()
        return self.returncode

    def _look(self, timeout_s):
        """Take the status of the process if it has ended by then."""
        if self.returncode is None:
            self._receive(2, timeout_s)
            if self._received.count(b"\n") == 2:
                self.returncode = os.waitstatus_to_exitcode(int(self._received.split()[1]))
                self._status.close()
