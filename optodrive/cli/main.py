"""The command line: one line an error, exit status 0 done, 1 failed, 2 bad input."""

import os
import sys
from typing import Any

import typer

from optodrive.cli import (
    config,
    control,
    diagnose,
    doctor,
    field,
    helios,
    home,
    plan,
    play,
    recording,
    serve,
    service,
    simulate,
    validate,
    wire,
)
from optodrive.cli.calibrate import group as calibrate
from optodrive.core.errors import OptodriveError

EXIT_INTERRUPTED = 130
UsageError: Any = typer.BadParameter.__bases__[0]
"""The base of every complaint about arguments; typer brings its own copy of click, or uses click's."""

app = typer.Typer(
    name="optodrive",
    help="Drive a tactile display with projected light.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for module in (
    serve,
    home,
    calibrate,
    field,
    service,
    control,
    play,
    plan,
    simulate,
    helios,
    recording,
    diagnose,
    validate,
    config,
    wire,
    doctor,
):
    module.register(app)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its status."""
    # No command calls BLAS; its threads alone would cost a tenth of a second to start.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: list[str]) -> int:
    """Run the command line; every error it knows becomes one line on stderr and an exit status."""
    try:
        status = app(args=arguments, prog_name="optodrive", standalone_mode=False)
        sys.stdout.flush()
        if status == EXIT_INTERRUPTED:  # some versions of typer turn a Ctrl-C into a status
            raise KeyboardInterrupt
        return status if isinstance(status, int) else 0
    except OptodriveError as error:
        print(f"optodrive: {error}", file=sys.stderr)
        return error.exit_status
    except (typer.Abort, KeyboardInterrupt):
        print("optodrive: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except UsageError as error:
        message = " ".join(error.format_message().split())
        if message:  # without arguments there is none: help was shown instead
            print(f"optodrive: {message}", file=sys.stderr)
        return 2
    except OSError as error:
        # What is still buffered cannot be written either; without this the interpreter would complain at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            return 0  # the reader has gone: nobody is left to tell
        print(f"optodrive: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    main()
