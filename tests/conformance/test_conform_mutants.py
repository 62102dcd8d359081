"""Mutation test of the suite: for each guard, boards that violate it fail its scenarios."""

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import mutants
import pytest
from all_scenarios import GUARD_MODULES, SCENARIOS
from process_board import ProcessKind, has_subject
from scenario import AT_ONCE, GUARDS, judge


class Mutant(NamedTuple):
    """A board that violates a guard.

    name: of the simulated board's mutant, or the C core's MUTANT
    """

    board: str
    guard: str
    name: str


MUTANTS = [Mutant("python", name.partition("_")[0].upper(), name) for name in mutants.MUTANTS]
MUTANTS += [Mutant("c", guard, guard.removeprefix("B")) for guard in GUARDS]
MUTANTS += [Mutant("c", "B14", "104"), Mutant("c", "B17", "111"), Mutant("c", "B17", "112")]
RULES = [Mutant("c", "trigger", number) for number in ("108", "109", "110")]
"""Boards that break a rule which is no guard."""


def caught_by(kind, guard):
    """Return the first scenario of a guard that a board fails, '' if it passes all."""
    for case in SCENARIOS:
        if case.subject == guard:
            try:
                judge(kind, case)
            except AssertionError:
                return case.name
    return ""


def assert_caught(mutant, scenario):
    print(f"{mutant.guard}: {mutant.board}'s {mutant.name} is caught by {scenario}")
    assert scenario, "passes every scenario of its guard"


@pytest.mark.parametrize("mutant", [*MUTANTS, *RULES], ids="-".join)
def test_caught(mutant, virtual, monkeypatch):
    if mutant.board == "python":
        monkeypatch.setattr(*mutants.MUTANTS[mutant.name]())
        kind = virtual("python")
    else:
        kind = virtual("c", int(mutant.name))
    assert_caught(mutant, caught_by(kind, mutant.guard))


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("guard", GUARDS)
def test_caught_on_the_emulated_pico(guard, virtual):
    mutant = Mutant("pico", guard, guard.removeprefix("B"))
    kind = "pico" if has_subject("pico", guard) else "pico-xy2"
    assert_caught(mutant, caught_by(virtual(kind, int(mutant.name)), guard))


@pytest.fixture(scope="module")
def verdicts(request, ready):
    """Return the futures of `caught_by` for the selected mutants as processes."""

    def find(mutant):
        kind = ProcessKind(mutant.name, (sys.executable, str(Path(mutants.__file__)), mutant.name))
        return caught_by(kind if mutant.board == "python" else ready("host", int(mutant.name)), mutant.guard)

    requested = [
        item.callspec.params["mutant"] for item in request.session.items if item.function is test_caught_as_a_process
    ]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        yield {mutant: pool.submit(find, mutant) for mutant in requested}


@pytest.mark.slow
@pytest.mark.parametrize("mutant", MUTANTS, ids="-".join)
def test_caught_as_a_process(mutant, verdicts):
    assert_caught(mutant, verdicts[mutant].result())


def test_every_guard_has_scenarios_and_mutants():
    assert {mutant.guard for mutant in MUTANTS if mutant.board == "c"} == set(GUARDS)
    assert {mutant.guard for mutant in MUTANTS if mutant.board == "python"} == {*GUARDS[:13], "B17"}
    assert {case.subject for case in SCENARIOS if case.module in GUARD_MODULES} == set(GUARDS)
