"""Terms with inner states are found in hidden pixels, and nothing where nothing is hidden."""

import pytest

from hidden_pixels import HIDDEN, draw_recording
from optodrive.lab.pixel_discovery import discover_in_pixel

pytestmark = pytest.mark.timeout(900)
SEED = 100
"""Of judging; the method was developed on those below 10."""


def find(seed, name=""):
    """Return class and place of the strongest finding, and those of all sure names."""
    answer = discover_in_pixel(draw_recording(seed, name))
    found = [(each.kind, each.term.chosen.where, each.term.is_sure) for each in answer.findings]
    print(f"| {name} | {found} | {answer.error_before:.2f} → {answer.error_after:.2f} | {answer.elapsed_s:.0f} s |")
    return found


def is_right(name, kind, where):
    """Return whether a class and a place are those that are hidden. A memory of the gas's heat is a second node."""
    if HIDDEN[name][0] == "second node":
        return kind in ("second node", "memory") and where == "dgas/dt"
    return (kind, where) == (HIDDEN[name][0], "displacement")


@pytest.mark.parametrize("name", ["dead travel", "ringing"])
def test_what_a_membrane_remembers_is_found(name):
    (kind, where, _), *further = find(1, name)
    assert is_right(name, kind, where)
    assert not further


@pytest.mark.slow
def test_most_of_twelve_hidden_memories_are_found_and_no_sure_name_is_wrong():
    answers = {name: find(SEED + number, name) for number, name in enumerate(HIDDEN)}
    right = [name for name, found in answers.items() if found and is_right(name, *found[0][:2])]
    assert len(right) >= 8
    sure = [(name, kind, where) for name, found in answers.items() for kind, where, is_sure in found if is_sure]
    assert [each for each in sure if not is_right(*each)] == []


@pytest.mark.parametrize("count", [1, pytest.param(12, marks=pytest.mark.slow)])
def test_nothing_is_named_where_nothing_is_hidden(count):
    assert [found for number in range(count) if (found := find(SEED + 50 + number))] == []
