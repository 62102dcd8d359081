"""`optodrive calibrate`: every subcommand accepts its own options only."""

import pytest

from optodrive.cli.main import run


def test_without_a_subcommand_the_help_lists_all_five(capsys):
    assert run(["calibrate"]) == 2
    output = capsys.readouterr().out
    assert all(f" {name} " in output for name in ("field", "camera", "board", "servo", "pixels"))


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["--spots", "spots.csv"], "--spots"),
        (["field", "spots.csv", "--manual"], "--manual"),
        (["camera", "folder", "--model", "model.toml"], "--model"),
        (["board", "--spots", "spots.csv"], "--spots"),
        (["servo", "recording.h5", "--report", "report.html"], "--report"),
        (["pixels", "recording.h5", "--readings", "3"], "--readings"),
    ],
)
def test_an_option_of_another_subcommand_is_an_unknown_option(capsys, arguments, option):
    assert run(["calibrate", *arguments]) == 2
    error = capsys.readouterr().err
    assert f"No such option: {option}" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(("option", "value"), [("--target-rms-um", "0"), ("--spots-max", "8"), ("--readings", "101")])
def test_a_number_out_of_range_is_named_before_the_board_is_opened(capsys, option, value):
    assert run(["calibrate", "board", option, value]) == 2
    assert capsys.readouterr().err.startswith(f"optodrive: {option}: got {value}")
