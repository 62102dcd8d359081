"""The command line `optodrive`.

An error is one line on stderr; `exit_status.py` states the exit statuses.
"""

import os
import sys
from importlib.metadata import version
from typing import Annotated, Any

import typer

from optodrive.cli import (
    config,
    control,
    diagnose,
    docs,
    doctor,
    field,
    first_light,
    helios,
    home,
    patterns,
    plan,
    play,
    recording,
    serve,
    service,
    simulate,
    support,
    terms,
    token,
    validate,
    wire,
)
from optodrive.cli.calibrate import group as calibrate
from optodrive.cli.exit_status import INTERRUPTED, SUMMARY
from optodrive.core.errors import OptodriveError

UsageError: Any = typer.BadParameter.__bases__[0]
"""Base class of errors about arguments; typer contains its own copy of click or uses the installed one."""

app = typer.Typer(
    name="optodrive",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _print_version(requested: bool) -> None:
    if requested:
        print(f"optodrive {version('optodrive')}")
        raise typer.Exit


@app.callback(epilog=SUMMARY)
def _select(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Drive a tactile display with projected light."""


for module in (
    serve,
    home,
    first_light,
    calibrate,
    field,
    service,
    control,
    play,
    patterns,
    plan,
    simulate,
    helios,
    recording,
    diagnose,
    terms,
    validate,
    config,
    token,
    wire,
    doctor,
    support,
    docs,
):
    module.register(app)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its status."""
    # No command needs a multithreaded BLAS; starting its threads takes 0.1 s.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: list[str]) -> int:
    """Run the command line and return its exit status. Print a known error as one line on stderr."""
    try:
        status = app(args=arguments, prog_name="optodrive", standalone_mode=False, obj=tuple(arguments))
        sys.stdout.flush()
        if status == INTERRUPTED:  # some versions of typer convert Ctrl-C to a status
            raise KeyboardInterrupt
        return status if isinstance(status, int) else 0
    except OptodriveError as error:
        print(f"optodrive: {error}", file=sys.stderr)
        return error.exit_status
    except (typer.Abort, KeyboardInterrupt):
        print("optodrive: interrupted", file=sys.stderr)
        return INTERRUPTED
    except UsageError as error:
        message = " ".join(error.format_message().split())
        if message:  # empty without arguments: typer has printed the help
            print(f"optodrive: {message}", file=sys.stderr)
        return 2
    except OSError as error:
        # Buffered output cannot be written either; redirecting it prevents a second error at interpreter exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            return 0  # the reader of stdout has exited
        print(f"optodrive: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    main()
