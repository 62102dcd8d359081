"""Start of child processes: forks of a loaded process, and modules in a fresh interpreter.

No child outlives the process that watches it: the kernel ends it with its parent, also when that is killed.
"""

import ctypes
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress

from optodrive.core.beat import OUT_OF_MEMORY, BeatWriter, SupervisorGoneError
from optodrive.core.errors import OptodriveError

PR_SET_PDEATHSIG, PR_SET_NAME = 1, 15
IGNORED_SIGNALS = (signal.SIGINT, signal.SIGHUP, signal.SIGPIPE, signal.SIGXFSZ)
"""A terminal sends SIGINT and SIGHUP to every process of its group. The supervisor alone decides what they mean.

A write to a closed pipe or beyond the size limit of files is an error of that write, as in every Python program.
"""
_libc = ctypes.CDLL(None, use_errno=True)


def die_with_parent(number: signal.Signals = signal.SIGKILL) -> None:
    """Let the kernel send this process a signal when its parent dies. SIGKILL ends it even while it is suspended."""
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
