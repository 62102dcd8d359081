"""The command line: one line an error, exit status 0 done, 1 failed, 2 bad input."""

import os
import sys

import click
import typer

from optodrive.cli import config_cmd, control, plan, play, serve, simulate, validate_cmd
from optodrive.errors import OptodriveError

app = typer.Typer(
    name="optodrive",
    help="Drive a tactile display with projected light.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for module in (serve, control, play, plan, simulate, validate_cmd, config_cmd):
    module.register(app)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with its status."""
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: list[str]) -> int:
    """Run the command line; every error it knows becomes one line on stderr and an exit status."""
    try:
        app(args=arguments, prog_name="optodrive", standalone_mode=False)
    except OptodriveError as error:
        print(f"optodrive: {error}", file=sys.stderr)
        return error.exit_status
    except click.exceptions.Exit as error:
        return error.exit_code
    except click.exceptions.Abort:
        print("optodrive: interrupted", file=sys.stderr)
        return 130
    except click.ClickException as error:
        print(f"optodrive: {error.format_message()}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader has gone: nobody is left to tell
        return 0
    return 0


if __name__ == "__main__":
    main()
