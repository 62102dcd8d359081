"""The commands of the command line. Only the module of the command that runs is imported."""

import os
import re
import sys
import termios
from importlib import import_module
from typing import Annotated, Any

import typer

from optodrive import __version__
from optodrive.cli.invocation import SUMMARY, Invocation
from optodrive.cli.signals import INTERRUPTED, report_interruption
from optodrive.core.daemon_url import check_environment
from optodrive.core.errors import InputError, OptodriveError

PYDANTIC_PHRASES = re.compile(r"Value error, |, unable to parse string as an? \w+")
"""What pydantic adds to the reason why an option's value is refused."""
UsageError: Any = typer.BadParameter.__bases__[0]
"""Base class of errors about arguments; typer contains its own copy of click or uses the installed one."""

MODULES = {
    "serve": ("serve",),
    "commissioning": ("home", "first-light"),
    "calibrate.group": ("calibrate",),
    "field": ("field",),
    "service": ("service",),
    "control": ("status", "arm", "disarm", "dim", "pause", "resume", "reload", "stop"),
    "play": ("push", "play"),
    "braille": ("braille",),
    "fingers": ("fingers",),
    "osc": ("osc",),
    "patterns": ("patterns",),
    "plan": ("plan",),
    "simulate": ("simulate",),
    "study": ("study",),
    "dac": ("dac",),
    "recording": ("recording",),
    "diagnose": ("diagnose",),
    "discover": ("discover",),
    "terms": ("terms",),
    "validate": ("validate",),
    "config": ("config",),
    "token": ("token",),
    "wire": ("wire",),
    "board": ("board",),
    "doctor": ("doctor",),
    "support": ("support",),
    "docs": ("docs",),
}
"""Commands by module below `optodrive.cli`, in the order of the help: its functions of these names, or its GROUP."""

DEFAULTS = {"study": "run"}
"""Groups with a command that also runs without its name."""

UNCONDITIONAL = ("stop", "support")
"""Commands that a wrong environment does not prevent: what makes dark, and what reports."""


def run_command(arguments: list[str], stopped: dict[str, Any] | None = None) -> int:
    """Run a command and return its exit status. Print a known error as one line on stderr.

    stopped: result of the link process, if it was stopped already
    """
    modules: dict[str, Any] = sys.modules
    modules.setdefault("httpx._main", None)  # its own command line, which it leaves out where rich is not installed
    invocation = Invocation(tuple(arguments), stopped)
    command = arguments[0] if arguments else None
    root = typer.main.get_command(build_app(command))
    arguments = name_default(root, arguments)
    try:
        if command not in UNCONDITIONAL:
            check_environment()
        _refuse_repeated_option(root, arguments)
        status = root(args=arguments, prog_name="optodrive", standalone_mode=False, obj=invocation)
        sys.stdout.flush()
        if status == INTERRUPTED:  # some versions of typer convert Ctrl-C to a status
            raise KeyboardInterrupt
        if command == "stop":  # the display that it names is dark, but perhaps another one was meant
            check_environment()
        return status if isinstance(status, int) else 0
    except OptodriveError as error:
        print(f"optodrive: {error}", file=sys.stderr)
        return error.exit_status
    except (typer.Abort, KeyboardInterrupt):
        return report_interruption()
    except UsageError as error:
        message = PYDANTIC_PHRASES.sub("", " ".join(error.format_message().split()))
        message = message.replace(": Input should be ", ": expected ")
        if message:  # empty without arguments: typer has printed the help
            print(f"optodrive: {message}", file=sys.stderr)
        return 2
    except (OSError, termios.error) as error:  # of a terminal, termios.error is no OSError
        # Buffered output cannot be written either; redirecting it prevents a second error at interpreter exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            return 0  # the reader of stdout has exited
        print(f"optodrive: {error}", file=sys.stderr)
        return 1


def name_default(root: Any, arguments: list[str]) -> list[str]:
    """Return the arguments with the name of the group's default command, if another word than a command follows."""
    group, rest = arguments[:1], arguments[1:]
    default = DEFAULTS.get(group[0]) if group else None
    if default is None or not rest or rest[0] in (*root.commands[group[0]].commands, "--help"):
        return arguments
    return [*group, default, *rest]


def _refuse_repeated_option(command: Any, arguments: list[str]) -> None:
    """Raise InputError for an option that stands twice, of which only the last value would count."""
    words, seen = iter(arguments), set()
    for word in words:
        subcommands = getattr(command, "commands", {})
        if word in subcommands:
            command = subcommands[word]
            continue
        if word == "--":
            return
        name, has_value, value = word.partition("=")
        option = next((each for each in command.params if name[:2] == "--" and name in _list_flags(each)), None)
        if option is None:
            continue
        if not option.is_flag and not has_value:
            value = next(words, "")
        if option in seen and not option.multiple:
            raise InputError(name, name if option.is_flag else value, "each option once")
        seen.add(option)


def _list_flags(parameter: Any) -> tuple[str, ...]:
    return (*parameter.opts, *parameter.secondary_opts)


def build_app(command: str | None = None) -> typer.Typer:
    """Build the command line with one command, or with all of them if there is none of this name."""
    app = typer.Typer(name="optodrive", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
    app.callback(epilog=SUMMARY)(_select)
    for name in [name for name, commands in MODULES.items() if command in commands] or MODULES:
        module, commands = import_module(f"optodrive.cli.{name}"), MODULES[name]
        if hasattr(module, "GROUP"):
            app.add_typer(module.GROUP, name=commands[0])
            continue
        for each in commands:
            app.command(each)(getattr(module, each.replace("-", "_")))
    return app


def _print_version(requested: bool) -> None:
    if requested:
        print(f"optodrive {__version__}")
        raise typer.Exit


def _select(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Drive a tactile display with projected light."""
