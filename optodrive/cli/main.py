"""The command line `optodrive`.

An error is one line on stderr; `invocation.py` states the exit statuses.

STOP leaves first. A command of a few milliseconds is what a person counts on who presses Enter with the laser on, so
`optodrive stop` imports sockets and JSON, sends, and only then imports the command line and prints the state. What is
not exactly `stop` with its own options takes the usual way.
"""

import os
import sys
from typing import Any

from optodrive.cli.direct_stop import stop_directly
from optodrive.cli.signals import end_by_ctrl_c, leave, report_interruption, was_interrupted
from optodrive.core.daemon_url import read_default_url
from optodrive.core.errors import OptodriveError
from optodrive.core.processes import collect_seldom, skip_last_collection


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its status."""
    try:
        end_by_ctrl_c()
        open_closed_streams()
        collect_seldom()
        # No command needs a multithreaded BLAS; starting its threads takes 0.1 s.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        # Nor plugins of pydantic, for which it reads the entry points of everything that is installed.
        os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
        status = run(sys.argv[1:] if arguments is None else arguments)
        leave()
    except BaseException as error:
        # An extension module whose import is interrupted raises an error of its own.
        if not isinstance(error, KeyboardInterrupt) and not was_interrupted():
            raise
        status = report_interruption()
    skip_last_collection()
    sys.exit(status)


def open_closed_streams() -> None:
    """Open /dev/null in place of standard streams that the caller has closed.

    The next file opened would take their numbers: text for stderr would go to the port of the board.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # opened at the lowest free number: this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if name == "stdin" else "w", encoding="utf-8", closefd=False))  # noqa: SIM115


def run(arguments: list[str]) -> int:
    """Run the command line and return its exit status. Print a known error as one line on stderr."""
    try:
        stopped = _stop_first(arguments)
    except OptodriveError as error:
        print(f"optodrive: {error}", file=sys.stderr)
        return error.exit_status
    from optodrive.cli.commands import run_command

    return run_command(arguments, stopped)


def _stop_first(arguments: list[str]) -> dict[str, Any] | None:
    """Stop at the link process if this is plainly `stop`. Return its result, or None if nothing was stopped."""
    if arguments[:1] != ["stop"]:
        return None
    url = read_default_url()
    options = iter(arguments[1:])
    for option in options:
        if option == "--url":
            url = next(options, "")
        elif option.startswith("--url="):
            url = option.removeprefix("--url=")
        elif option != "--json":
            return None
    return stop_directly(url)


if __name__ == "__main__":
    main()
