"""Child processes: their start, forked from a loaded process or in a fresh interpreter, and their channel upwards.

No child outlives the process that watches it: the kernel ends it with its parent, also when that is killed. Over the
channel to the supervisor beats and reports go up, and control messages come down. It is a socket pair that preserves
message boundaries; each packet is one JSON object with a `kind`. Its end of file tells a child that the supervisor is
dead.
"""

import ctypes
import json
import os
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any

from optodrive.core.errors import OptodriveError

BEAT_INTERVAL_S = 0.1
PACKET_MAX_BYTES = 256_000
BEAT, READY, FAILED = "beat", "ready", "failed"
OUT_OF_MEMORY = "out of memory"
"""Reported by a process that could not allocate memory, which ends it."""


class SupervisorGoneError(OptodriveError):
    """The supervisor has ended, so its children end too."""

    code = "supervisor_gone"


class BeatWriter:
    """The child's end. Its methods never block.

    descriptor: inherited descriptor of the socket, owned from now on; now_s: monotonic clock
    """

    def __init__(self, descriptor: int, now_s: Callable[[], float] = time.monotonic) -> None:
        self._socket = socket.socket(fileno=descriptor)
        self._socket.setblocking(False)
        self._now_s = now_s
        self._beaten_s = -float("inf")

    def fileno(self) -> int:
        """Return the descriptor that becomes readable for a control message, or when the supervisor is dead."""
        return self._socket.fileno()

    def beat(self) -> None:
        """Prove that the caller's loop runs. Call it in every iteration. At most one packet per interval is sent."""
        now_s = self._now_s()
        if now_s - self._beaten_s >= BEAT_INTERVAL_S:
            self._beaten_s = now_s
            self.send({"kind": BEAT})

    def report_ready(self) -> None:
        """Report that the process serves its callers."""
        self.send({"kind": READY})

    def report_failure(self, message: str, exit_status: int = 1) -> None:
        """Report in one line why the process cannot serve. It ends afterwards."""
        self.send({"kind": FAILED, "message": message, "exit_status": exit_status})

    def send(self, fields: dict[str, Any]) -> None:
        """Send a message, or drop it while the supervisor does not read."""
        with suppress(OSError):
            self._socket.send(json.dumps(fields).encode())

    def receive(self) -> list[dict[str, Any]]:
        """Return the control messages that have arrived. Raise SupervisorGoneError at the end of file."""
        messages: list[dict[str, Any]] = []
        while True:
            try:
                packet = self._socket.recv(PACKET_MAX_BYTES)
            except BlockingIOError:
                return messages
            except OSError:
                packet = b""
            if not packet:
                raise SupervisorGoneError("the supervisor has ended")
            messages.append(json.loads(packet))

    def close(self) -> None:
        """Close the channel."""
        self._socket.close()


PR_SET_PDEATHSIG, PR_SET_NAME = 1, 15
IGNORED_SIGNALS = (signal.SIGINT, signal.SIGHUP, signal.SIGPIPE, signal.SIGXFSZ)
"""A terminal sends SIGINT and SIGHUP to every process of its group. The supervisor alone decides what they mean.

A write to a closed pipe or beyond the size limit of files is an error of that write, as in every Python program.
"""
_libc = ctypes.CDLL(None, use_errno=True)


def die_with_parent(number: signal.Signals = signal.SIGKILL) -> None:
    """Let the kernel send this process a signal when its parent dies. SIGKILL ends it even while it is suspended."""
    # The kernel does it, also after kill -9 of the parent, which no handler survives.
    _libc.prctl(PR_SET_PDEATHSIG, number, 0, 0, 0)


def fork_child(run: Callable[[], int], name: str, kept: Iterable[int]) -> int:
    """Fork a child that calls `run` and exits with the status that it returns. Return its process id.

    name: of the process, for ps; kept: descriptors that stay open besides 0, 1 and 2. The child has the default signal
    handlers, except for ignored signals, and dies with this process. RuntimeError if this process has several threads,
    because a lock that another thread holds would stay locked in the child.
    """
    if threading.active_count() != 1:
        raise RuntimeError(f"a process with {threading.active_count()} threads must not fork: {threading.enumerate()}")
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # a full disk
            stream.flush()
    parent = os.getpid()
    # A signal between fork and _separate would run the parent's handler in the child.
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    pid = os.fork()
    if pid != 0:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
        return pid
    status = 1
    try:
        _separate(parent, name, {0, 1, 2, *kept})
        status = run()
    except BaseException:  # the only way out of this process is the next line
        traceback.print_exc()
    finally:
        with suppress(BaseException):
            sys.stdout.flush()
            sys.stderr.flush()
        # No atexit and no finally of the parent's frames: those would remove its sockets and stop its children.
        os._exit(status)


def _separate(parent: int, name: str, kept: set[int]) -> None:
    """Give up the parent's signal handlers and descriptors, and let this process die with the parent."""
    die_with_parent()
    _libc.prctl(PR_SET_NAME, name.encode(), 0, 0, 0)
    if os.getppid() != parent:  # it died before the signal was requested
        os._exit(1)
    signal.set_wakeup_fd(-1)
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
        if signal.getsignal(number) is not None:  # not a signal that the C library uses itself
            signal.signal(number, signal.SIG_IGN if number in IGNORED_SIGNALS else signal.SIG_DFL)
    for text in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names are all that is needed
        if int(text) not in kept:
            with suppress(OSError):  # the descriptor of the listing itself
                os.close(int(text))
    signal.pthread_sigmask(signal.SIG_SETMASK, ())


def fork_with_beat(target: Callable[[BeatWriter], None], name: str, channel: int, kept: Iterable[int] = ()) -> int:
    """Fork a child that calls `target` with its end of the channel and reports its failure. Return its process id."""

    def run() -> int:
        beat = BeatWriter(channel)
        try:
            target(beat)
        except SupervisorGoneError:
            return 1
        except OptodriveError as error:
            beat.report_failure(str(error), error.exit_status)
            return error.exit_status
        except MemoryError:
            beat.report_failure(OUT_OF_MEMORY)
            return 1
        except Exception as error:
            beat.report_failure(repr(error))
            raise
        return 0

    return fork_child(run, name, [channel, *kept])


def execute_module(module: str, arguments: Sequence[str], inherited: Iterable[int]) -> int:
    """Start a module in a fresh interpreter and return its process id. inherited: descriptors that it receives."""
    actions = [(os.POSIX_SPAWN_DUP2, descriptor, descriptor) for descriptor in inherited]  # clears close-on-exec
    command = [sys.executable, "-P", "-m", module, *arguments]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # threads that nothing here needs
    return os.posix_spawn(sys.executable, command, environment, file_actions=actions, setsigmask=())


def describe_end(wait_status: int) -> str:
    """Describe how a process has ended, from its status of waitpid."""
    code = os.waitstatus_to_exitcode(wait_status)
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
