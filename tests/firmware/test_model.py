"""Exhaustive search of the SPIN models of link and gate, and of epochs. Each removed rule is detected."""

import re
import subprocess

import pytest

from optodrive.device.config_file import locate_shipped

MODELS = locate_shipped().parent / "firmware_protocol" / "model"


def explored(folder, mutant, name="board.pml"):
    """Run pan. Return the numbers of errors and of states, and its output.

    The error of a mutant is found so soon that pan is not worth optimising.
    """
    for command in (
        ["spin", f"-DMUTANT={mutant}", "-a", MODELS / name],
        ["gcc", "-O0" if mutant else "-O2", "-DSAFETY", "-DNOFAIR", "-o", "pan", "pan.c"],
    ):
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
    reported = subprocess.run(
        ["./pan", "-m2000000", "-w24"], cwd=folder, check=True, capture_output=True, text=True
    ).stdout
    assert "Search not completed" not in reported or mutant, reported
    return int(re.search(r"errors: (\d+)", reported)[1]), int(re.search(r"(\d+) states, stored", reported)[1]), reported


def test_no_interleaving_violates_a_rule(tmp_path):
    errors, states, reported = explored(tmp_path, 0)
    assert errors == 0, reported
    assert states > 3_000_000


@pytest.mark.parametrize("mutant", [1, 2, 3, 4, pytest.param(5, marks=pytest.mark.slow), 6])
def test_a_removed_rule_is_detected(tmp_path, mutant):
    errors, _, reported = explored(tmp_path, mutant)
    assert errors == 1
    assert "assertion violated" in reported


@pytest.mark.parametrize("mutant", [7, 8])
def test_a_change_of_state_that_the_table_does_not_have_is_detected(tmp_path, mutant):
    _, _, reported = explored(tmp_path, mutant)
    assert "assertion violated ((state==" in reported


def test_no_interleaving_emits_what_was_accepted_in_an_older_epoch_or_built_before_a_pause(tmp_path):
    errors, states, reported = explored(tmp_path, 0, "epochs.pml")
    assert errors == 0, reported
    assert states > 2_000_000


@pytest.mark.parametrize(
    ("gate", "violated"),
    [
        (1, "(accepted[(argument%4)]==armed_epoch)"),
        (2, "(accepted[(argument%4)]==armed_epoch)"),
        (3, " !((paused&&(flushed==pause)))"),
        (4, "((argument/4)>=flushed)"),
        (5, "(accepted[(argument%4)]==armed_epoch)"),  # the rest of a paused push is emitted after a STOP
    ],
)
def test_a_removed_gate_is_detected(tmp_path, gate, violated):
    errors, _, reported = explored(tmp_path, gate, "epochs.pml")
    assert errors == 1
    assert f"assertion violated {violated}" in reported
