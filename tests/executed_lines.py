"""The work of a computation, as the number of lines that the interpreter executes: the same on every computer."""

import sys


def count_lines(call):
    """Return the number of lines of Python that a call executes in this thread."""
    count = 0

    def trace(frame, event, argument):
        nonlocal count
        count += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
    return count
