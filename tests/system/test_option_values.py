"""Values that options do not mean: each command refuses them in one line."""

from itertools import groupby

import pytest
import typer

from forked_process import OPTODRIVE, run_process
from optodrive.cli.commands import build_app, run_command

VALUES = ["", "-5", "99999999999999999999", "1\n2", "nan", "x"]
RUNS = {("serve", "--capture")}
"""Options for which some of the values are names of files, and the command runs until it is stopped."""
COMPILING = "optodrive: compiling kernels"


def list_options(command, path=()):
    """Yield the path of each command, each of its options and arguments with a value, and all its arguments."""
    for name, each in getattr(command, "commands", {}).items():
        yield from list_options(each, (*path, name))
    if hasattr(command, "commands"):
        return
    arguments = [each for each in command.params if each.param_type_name == "argument"]
    for parameter in command.params:
        if not getattr(parameter, "is_flag", False) and parameter.name != "help":
            yield path, parameter, arguments


OPTIONS = list(list_options(typer.main.get_command(build_app())))
COMMANDS = {path: list(each) for path, each in groupby(OPTIONS, lambda option: option[0])}
NUMBERS = [each for each in OPTIONS if each[1].type_descriptor.annotation in (int, float)]


def build_arguments(path, parameter, arguments, value):
    """Return a command line with one value, and names of files that do not exist for the required arguments."""
    places = [value if each is parameter else "none" for each in arguments if each is parameter or each.required]
    option = [] if parameter in arguments else [f"{parameter.opts[0]}={value}"]
    return [*path, *option, "--", *places]


@pytest.mark.parametrize("option", NUMBERS, ids=lambda option: f"{' '.join(option[0])} {option[1].opts[0]}")
def test_text_in_place_of_a_number_is_refused_before_anything_is_done(option, capfd):
    for value in ("", "x", "1\n2", "1e", "5 mW"):
        assert run_command(build_arguments(*option, value)) == 2
        out, errors = capfd.readouterr()
        assert out == ""
        assert errors.startswith("optodrive: ")
        assert errors.count("\n") == 1
        assert option[1].opts[0].strip("-").replace("-", "_").lower() in errors.lower().replace("-", "_")


@pytest.mark.slow
@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_no_value_of_any_option_ends_in_a_traceback(path, tmp_path):
    for option in COMMANDS[path]:
        for value in VALUES:
            if (path[0], option[1].opts[0]) in RUNS:
                continue
            command = [OPTODRIVE, *build_arguments(*option, value)]
            done = run_process(command, capture_output=True, text=True, cwd=tmp_path, input="")
            lines = [line for line in done.stderr.splitlines() if not line.startswith(COMPILING)]
            assert done.returncode in (0, 1, 2, 3), (command, done.stderr)
            assert len(lines) <= 1, (command, done.stderr)
            assert all(line.startswith("optodrive: ") for line in lines), command
            assert lines or done.returncode != 2, command
