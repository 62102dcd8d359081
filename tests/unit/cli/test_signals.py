"""A signal ends a command wherever it comes, and what a command does at its end is not interrupted."""

import os
import signal
import subprocess
import sys
from textwrap import dedent, indent

import pytest

PROGRAM = """
import gc, os, signal, sys, threading, time, weakref
from optodrive.cli import main, signals

NUMBER = signal.Signals[sys.argv[1]]
signals.STUCK_S = 1e4

class Finalized:
    def __del__(self):
        signal.raise_signal(NUMBER)

def go_on():
    while True:
        time.sleep(0.001)

def command(arguments):
    with signals.end_as_interrupted():
{body}

main.run = command
main.main([])
"""
GO_ON = """
        os.write(1, b"went on")
        go_on()
"""
LOST = {
    "nowhere else": "signal.raise_signal(NUMBER)",
    "a finalizer": "Finalized()",
    "a callback of a weak reference": """
        freed = threading.Lock()
        reference = weakref.ref(freed, lambda _: signal.raise_signal(NUMBER))
        del freed
    """,
    "a callback of the garbage collector": """
        gc.callbacks.append(lambda phase, _: phase == "start" and signal.raise_signal(NUMBER))
        gc.collect()
        gc.callbacks.clear()
    """,
    "code that catches everything": """
        try:
            signal.raise_signal(NUMBER)
        except BaseException:
            pass
    """,
    "code that drops it later": """
        try:
            try:
                signal.raise_signal(NUMBER)
            finally:
                time.sleep(2 * signals.REPEAT_S)
        except BaseException:
            pass
    """,
}
ONE_LINE = "optodrive: interrupted\n"


def run(body, number=signal.SIGINT, **options):
    lines = indent(dedent(body), 8 * " ")
    command = [sys.executable, "-c", PROGRAM.format(body=lines), number.name]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


@pytest.mark.parametrize(
    ("place", "number"),
    [
        *((place, signal.SIGINT) for place in LOST),
        *(("a finalizer", number) for number in (signal.SIGTERM, signal.SIGHUP)),
    ],
)
def test_a_signal_ends_a_command_that_drops_its_exception(place, number):
    done = run(dedent(LOST[place]) + dedent(GO_ON), number)
    assert (done.returncode, done.stderr) == (130, ONE_LINE), done
    if place == "nowhere else":
        assert done.stdout == ""


def test_what_a_command_does_at_its_end_is_not_interrupted():
    done = run(
        """
        try:
            signal.raise_signal(NUMBER)
        finally:
            until_s = time.monotonic() + 5 * signals.REPEAT_S
            while time.monotonic() < until_s:
                time.sleep(0.001)
            os.write(1, b"ended")
        """
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "ended", ONE_LINE)


def test_what_waits_for_ever_at_the_end_is_interrupted():
    """As the main thread does for a lock that its interruption has left taken. What comes after it still runs."""
    done = run(
        """
        signals.STUCK_S = 2 * signals.REPEAT_S
        taken = threading.Lock()
        taken.acquire()
        try:
            try:
                signal.raise_signal(NUMBER)
            finally:
                taken.acquire()
        finally:
            signals.STUCK_S = 1e4
            os.write(1, b"ended")
        """
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "ended", ONE_LINE)


def test_a_thread_that_does_not_end_does_not_hold_the_process():
    done = run(
        """
        leave = signals.leave

        def leave_soon():
            signals.STUCK_S = signals.REPEAT_S
            leave()

        signals.leave = leave_soon
        threading.Thread(target=go_on).start()
        signal.raise_signal(NUMBER)
        """
    )
    assert (done.returncode, done.stderr) == (-signal.SIGALRM, ONE_LINE)


def test_a_deferred_signal_interrupts_at_the_end_of_the_block():
    done = run(
        """
        with signals.defer_interruption() as defer:
            defer()
            for _ in range(2):
                signal.raise_signal(NUMBER)
                time.sleep(2 * signals.REPEAT_S)
            os.write(1, b"ended")
        go_on()
        """
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "ended", ONE_LINE)


def test_an_error_that_replaces_the_interruption_is_no_traceback():
    """As that of an extension module whose import is interrupted."""
    done = run(
        """
        try:
            signal.raise_signal(NUMBER)
        except KeyboardInterrupt:
            pass
        raise ImportError("numpy.core.multiarray failed to import")
        """
    )
    assert (done.returncode, done.stderr) == (130, ONE_LINE)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_what_the_caller_lets_a_command_ignore_stays_ignored(number):
    """As nohup does SIGHUP, and a shell SIGINT for a command in the background."""
    done = run(
        'signal.raise_signal(NUMBER)\nprint("went on", flush=True)',
        number,
        preexec_fn=lambda: signal.signal(number, signal.SIG_IGN),
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "went on\n", "")


def test_handlers_of_a_caller_in_this_process_are_restored():
    from optodrive.cli.signals import ENDING, end_as_interrupted

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGALRM, *ENDING)}
    with pytest.raises(KeyboardInterrupt), end_as_interrupted():
        os.kill(os.getpid(), signal.SIGTERM)
    assert before == {number: signal.getsignal(number) for number in before}
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
