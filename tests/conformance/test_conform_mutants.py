"""Mutation test of the suite: for each guard, boards that violate it fail its scenarios."""

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import guard_scenarios
import mutants
import order_scenarios
import pytest
import self_scenarios
import trust_scenarios
from bench import BoardKind
from scenario import AT_ONCE, GUARDS, SCENARIOS, judge

MODULES = [module.__name__ for module in (guard_scenarios, trust_scenarios, order_scenarios, self_scenarios)]


class Mutant(NamedTuple):
    """A board of a kind that violates a guard; name: of the Python mutant, or the C core's MUTANT."""

    board: str
    guard: str
    name: str


MUTANTS = [Mutant("python", name.partition("_")[0].upper(), name) for name in mutants.MUTANTS]
MUTANTS += [Mutant("host", guard, guard.removeprefix("B")) for guard in GUARDS]


def caught_by(mutant, ready):
    """Return the first scenario of its guard that a mutant fails, '' if it passes all."""
    kind = BoardKind(mutant.name, (sys.executable, str(Path(mutants.__file__)), mutant.name))
    if mutant.board != "python":
        kind = ready(mutant.board, int(mutant.name))
    for case in SCENARIOS:
        if case.subject == mutant.guard:
            try:
                judge(kind, case, excused=lambda _: False)
            except AssertionError:
                return case.name
    return ""


@pytest.fixture(scope="module")
def verdicts(request, ready):
    """Return the futures of `caught_by` for the selected mutants."""
    requested = [
        item.callspec.params["mutant"]
        for item in request.session.items
        if item.module is request.module and hasattr(item, "callspec")
    ]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        yield {mutant: pool.submit(caught_by, mutant, ready) for mutant in requested}


FIRST = {mutant.guard: mutant for mutant in reversed(MUTANTS) if mutant.board == "host"}
"""The C core's mutant of each guard; scripts/test --slow runs the others."""
CASES = [mutant if mutant in FIRST.values() else pytest.param(mutant, marks=pytest.mark.slow) for mutant in MUTANTS]


@pytest.mark.parametrize("mutant", CASES, ids=lambda mutant: f"{mutant.board}-{mutant.guard}-{mutant.name}")
def test_caught(mutant, verdicts):
    scenario = verdicts[mutant].result()
    print(f"{mutant.guard}: {mutant.board}'s {mutant.name} is caught by {scenario}")
    assert scenario, "passes every scenario of its guard"


def test_every_guard_has_scenarios_and_mutants():
    assert {mutant.guard for mutant in MUTANTS if mutant.board == "host"} == set(GUARDS)
    assert {mutant.guard for mutant in MUTANTS if mutant.board == "python"} == set(GUARDS[:13])
    assert {case.subject for case in SCENARIOS if case.module in MODULES} == set(GUARDS)
