"""When Python looks for garbage: seldom in a command, as usual in a process that lives on and has a deadline."""

import gc

USUAL_THRESHOLDS = (700, 10, 10)
"""Those of Python 3.11."""
COMMAND_THRESHOLD = 200_000
"""Objects created, less those deleted, between two collections; some 30 MiB of small ones."""


def collect_seldom() -> None:
    """Make collections of garbage rare in this process.

    What imports create is no garbage, and searching it again and again takes a quarter of the time of `optodrive plan`.
    """
    gc.set_threshold(COMMAND_THRESHOLD)


def settle_memory() -> None:
    """Collect the garbage of the start, and exempt all other objects from later collections.

    A collection would visit them for milliseconds, and in a fork copy every page. Later objects are collected as usual.
    """
    gc.set_threshold(*USUAL_THRESHOLDS)
    gc.collect()
    gc.freeze()


def skip_last_collection() -> None:
    """Exempt all objects from the collection at the interpreter's exit."""
    gc.freeze()
