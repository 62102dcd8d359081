"""Signals that end a command.

Python raises KeyboardInterrupt wherever the main thread happens to be. A finalizer or a callback of a weak reference
drops it, as do some extension modules, and the command would go on. Inside a lock that is written in Python it leaves
the lock taken, and what waits for it would wait without end. The exception of this module is therefore raised again
until it is on its way out of the command, and again if it makes no progress.
"""

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

INTERRUPTED = 130
"""Exit status of a command that a signal has ended."""
ENDING = (signal.SIGTERM, signal.SIGHUP)
REPEAT_S = 0.1
STUCK_S = 10.0
"""Longest time that one step of the end may take, such as the confirmation of STOP."""
_raised_s = 0.0
_is_deferred = False


def end_by_ctrl_c() -> None:
    """Let Ctrl-C end this process at any moment, unless its caller lets it ignore Ctrl-C."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        _install(signal.SIGINT)
        sys.unraisablehook = _report_unraisable


@contextmanager
def end_as_interrupted() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block like Ctrl-C, so that it leaves nothing behind and says one line."""
    before = _install(*ENDING)
    try:
        yield
    finally:
        if before[signal.SIGALRM] is not _interrupt:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def defer_interruption() -> Iterator[Callable[[], None]]:
    """Yield a function from whose call on no signal interrupts the block. One that comes interrupts at the end."""
    global _is_deferred

    def defer() -> None:
        global _is_deferred
        _is_deferred = True

    try:
        yield defer
    finally:
        _is_deferred = False


def was_interrupted() -> bool:
    """Return whether a signal has interrupted this process."""
    return signal.getitimer(signal.ITIMER_REAL)[0] > 0.0


def report_interruption() -> int:
    """Say that a signal has ended the command, and return its exit status."""
    leave()
    print("optodrive: interrupted", file=sys.stderr)
    return INTERRUPTED


def leave() -> None:
    """Let the next signal end this process without a word: its command has ended, and only the interpreter has not.

    After an interruption so does the kernel, where a thread that the interpreter waits for does not end.
    """
    interrupted = was_interrupted()
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    for number in (signal.SIGINT, *ENDING, signal.SIGALRM):
        if signal.getsignal(number) is _interrupt:
            signal.signal(number, signal.SIG_DFL)
    if interrupted:
        signal.setitimer(signal.ITIMER_REAL, STUCK_S)


def _install(*numbers: signal.Signals) -> dict[signal.Signals, Any]:
    """Let signals interrupt the main thread, and the alarm. Return the former handlers.

    What the caller lets this process ignore, as nohup does SIGHUP, stays ignored.
    """
    heard = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    return {number: signal.signal(number, _interrupt) for number in (signal.SIGALRM, *heard)}


def _interrupt(number: int, frame: object) -> None:
    """Raise KeyboardInterrupt. Do so again for the alarm if the one before was deferred or dropped, or is stuck."""
    global _raised_s
    now_s = time.monotonic()
    signal.setitimer(signal.ITIMER_REAL, REPEAT_S, REPEAT_S)
    is_repetition = number == signal.SIGALRM
    if _is_deferred or (is_repetition and _is_handled() and now_s - _raised_s < STUCK_S):
        return
    _raised_s = now_s
    raise KeyboardInterrupt


def _is_handled() -> bool:
    """Return whether the running code handles a KeyboardInterrupt or an error that has replaced it."""
    error = sys.exception()
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _report_unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    # After an interruption it is that, which comes again, or about an object that it has left half built.
    if not was_interrupted():
        sys.__unraisablehook__(unraisable)
