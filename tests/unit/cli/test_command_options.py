"""Options, commands and variables that the command line does not have are refused by name, with the nearest."""

import inspect
import re
from difflib import get_close_matches
from enum import EnumType

import pytest
from typer.main import get_command

from optodrive.cli.commands import DEFAULTS, build_app
from optodrive.cli.main import run
from optodrive.client import Display
from optodrive.core.daemon_url import ENVIRONMENT_VARIABLES
from optodrive.daemon.api import tokens


def list_commands(command, path=()):
    """List all commands with their words."""
    if not hasattr(command, "commands"):
        yield path, command
        return
    for name, each in command.commands.items():
        yield from list_commands(each, (*path, name))


ROOT = get_command(build_app())
COMMANDS = [pytest.param(path, command, id=" ".join(path)) for path, command in list_commands(ROOT)]
GROUPS = {path[:k] for path, _ in list_commands(ROOT) for k in range(len(path))}


def list_flags(command):
    return [flag for option in command.params for flag in (*option.opts, *option.secondary_opts) if flag[:2] == "--"]


@pytest.mark.parametrize(("path", "command"), COMMANDS)
def test_an_unknown_option_is_refused_by_name(path, command, capsys):
    assert not command.ignore_unknown_options
    assert not command.allow_extra_args
    assert run([*path, "--surely-unknown", "1"]) == 2
    assert capsys.readouterr().err == "optodrive: No such option: --surely-unknown\n"


@pytest.mark.parametrize(("path", "command"), COMMANDS)
def test_a_misspelt_option_is_refused_with_the_nearest(path, command, capsys):
    flags = list_flags(command)
    for flag in flags:
        wrong = flag + "x"
        assert run([*path, wrong]) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"optodrive: No such option: {wrong} ")
        assert get_close_matches(wrong, flags)[0] in re.findall(r"--[\w-]+", error)[1:], error
        if "_" in (underscored := f"--{flag[2:].replace('-', '_')}"):
            assert run([*path, underscored]) == 2
            assert flag in capsys.readouterr().err


@pytest.mark.parametrize(("path", "command"), COMMANDS)
def test_an_option_given_twice_is_refused(path, command, capsys):
    """In both forms and both names of a switch, and with values that look like options."""
    for option in command.params:
        flags = [flag for flag in (*option.opts, *option.secondary_opts) if flag[:2] == "--"]
        if not flags or option.multiple:
            continue
        first, second = ([flags[0]], [flags[-1]]) if option.is_flag else ([flags[0], "--x"], [f"{flags[0]}=--x"])
        status = run([*path, *first, *second])
        shown = flags[-1] if option.is_flag else "--x"
        refusal = f"optodrive: {flags[-1]}: got '{shown}', expected each option once\n"
        assert (status, capsys.readouterr().err) == (2, refusal)


@pytest.mark.parametrize("group", sorted(GROUPS - {(name,) for name in DEFAULTS}))
def test_an_unknown_command_is_refused_by_name(group, capsys):
    assert run([*group, "surely-unknown"]) == 2
    assert "No such command 'surely-unknown'" in capsys.readouterr().err


def test_a_group_takes_another_word_for_the_argument_of_its_default_command(capsys, tmp_path):
    for words in (["study"], ["study", "run"]):
        assert run([*words, "surely-unknown", "--out", str(tmp_path / "data")]) == 2
        assert capsys.readouterr().err.startswith("optodrive: study: got 'surely-unknown', expected a file, or ")
        assert run([*words, "detection", "--out", "a", "--out", "b"]) == 2
        assert capsys.readouterr().err == "optodrive: --out: got 'b', expected each option once\n"


def test_the_client_has_a_dry_run_where_a_command_has_one():
    commands = {path[-1] for path, command in list_commands(ROOT) if "--dry-run" in list_flags(command)}
    assert commands == {"push", "play"}
    for name in commands:
        assert "dry_run" in inspect.signature(getattr(Display, name)).parameters


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["play", "text", "text=a", "text=b"], "play text: text: got 'b', expected each parameter once"),
        (["play", "text", "a", "text=b"], "play text: text: got 'b', expected each parameter once"),
        (["play", "pixel", "--label", "a=1", "--label", "a=2"], "--label: got 'a=2', expected each key once"),
    ],
)
def test_a_repeated_value_is_refused(arguments, error, capsys):
    assert run(arguments) == 2
    assert capsys.readouterr().err == f"optodrive: {error}\n"


def test_a_misspelt_variable_of_the_environment_is_refused(monkeypatch, capsys):
    assert {tokens.ENVIRONMENT_VARIABLE, tokens.FILE_ENVIRONMENT_VARIABLE} < set(ENVIRONMENT_VARIABLES)
    monkeypatch.setenv("OPTODRIVE_TOKN", "secret")
    for path, _ in list_commands(ROOT):
        if path not in (("stop",), ("support",)):
            assert run([*path, "--help"]) == 2, path
            error = capsys.readouterr().err
            assert error == (
                "optodrive: environment: got 'OPTODRIVE_TOKN', expected a known variable, "
                "nearest is 'OPTODRIVE_TOKEN'\n"
            )


CHOICES = [
    pytest.param(path, option, id=" ".join((*path, option.opts[0])))
    for path, command in list_commands(ROOT)
    for option in command.params
    if isinstance(getattr(option, "type_descriptor", None) and option.type_descriptor.annotation, EnumType)
]


def test_some_options_have_choices():
    assert CHOICES


@pytest.mark.parametrize(("path", "option"), CHOICES)
def test_a_value_that_is_no_choice_is_refused_with_the_choices(path, option, capsys):
    assert run([*path, f"{option.opts[0]}=surely-unknown"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"optodrive: Invalid value for '{option.opts[0]}': 'surely-unknown' is not one of '")


@pytest.mark.parametrize("height_um", ["0", "-1", "1001", "nan"])
def test_a_height_that_no_dot_has_is_refused(height_um, capsys):
    assert run(["braille", "port", f"--height-um={height_um}"]) == 2
    assert "--height-um" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("port", "says"), [("80000", "expected less than or equal to 65535"), ("abc", "expected a valid integer\n")]
)
def test_a_number_outside_its_range_is_refused_in_our_words(port, says, capsys):
    assert run(["serve", f"--port={port}"]) == 2
    assert f"Invalid value for '--port': {says}" in capsys.readouterr().err
