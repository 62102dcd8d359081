"""Signals that end a command."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

ENDING = (signal.SIGTERM, signal.SIGHUP)


@contextmanager
def end_as_interrupted() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block like Ctrl-C, so that it leaves nothing behind and says one line."""
    before = {number: signal.signal(number, signal.default_int_handler) for number in ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
