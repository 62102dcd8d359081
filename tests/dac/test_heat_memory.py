"""Persistent budget state between plays."""

from dataclasses import fields, replace

import numpy as np
import pytest

from dac.bench import build_display, build_train
from optodrive.core.errors import InputError
from optodrive.core.types.plans import BudgetState
from optodrive.link.dac import heat_memory
from optodrive.link.dac.heat_memory import ZERO_OFFSET_S, HeatMemory
from optodrive.planning.limiter.limiter import build_cold_budget_state
from optodrive.planning.pipeline import plan_sequence

DAY_S = 1.7e9


@pytest.fixture
def memory(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(heat_memory, "read_boot", lambda: ("a run", DAY_S - 100.0))
    return HeatMemory.for_device("Helios 12/../3")


def after_a_play():
    display = build_display()
    heat, budget = display.build_cold_state()
    return display, plan_sequence(
        display, build_train(width_s=0.04, gap_s=0.004, duration_s=1.0, power_w=2.0), heat, budget
    ).budget


def test_the_file_lies_in_the_state_folder(memory, tmp_path):
    assert memory.path == tmp_path / "optodrive" / "Helios-12-3.npz"


def test_without_a_play_the_state_is_cold(memory):
    fresh = build_cold_budget_state(16)
    assert memory.load(DAY_S, fresh) is fresh


SHIFTED = ("at_s", "begun_s", "beam_end_s", "last_pulse_end_s", "recent_start_s")


def test_a_loaded_budget_counts_time_from_now(memory):
    _, budget = after_a_play()
    memory.save(budget, DAY_S)
    back = memory.load(DAY_S + 100.0, build_cold_budget_state(16))
    for item in fields(BudgetState):
        before, after = np.asarray(getattr(budget, item.name)), np.asarray(getattr(back, item.name))
        moved = 100.0 if item.name.endswith("_at_s") or item.name in SHIFTED else 0.0
        assert after == pytest.approx(before - moved, abs=1e-6)


def test_an_immediate_second_play_may_emit_less_than_a_cold_one(memory):
    display, budget = after_a_play()
    memory.save(budget, DAY_S)
    sequence = build_train(width_s=0.04, gap_s=0.004, duration_s=1.0, power_w=2.0)
    energies = []
    for later_s in (budget.at_s, 3600.0):
        recalled = memory.load(DAY_S + later_s, build_cold_budget_state(16))
        energies.append(plan_sequence(display, sequence, display.build_cold_state()[0], recalled).plan.energy_j.sum())
    from_cold = plan_sequence(display, sequence, *display.build_cold_state()).plan.energy_j.sum()
    assert energies[0] < 0.9 * from_cold
    assert energies[1] == pytest.approx(from_cold)


def test_a_killed_play_may_still_emit(memory):
    _, budget = after_a_play()
    memory.save(budget, DAY_S + ZERO_OFFSET_S)
    assert memory.load(DAY_S + 0.1, build_cold_budget_state(16)).at_s == pytest.approx(
        budget.at_s + ZERO_OFFSET_S - 0.1, abs=1e-6
    )


@pytest.mark.parametrize(("boot", "set_by_s", "passed_s"), [("a run", 3600.0, 1.0), ("the next", 3600.0, 3601.0)])
def test_a_clock_that_is_set_cools_nothing(memory, monkeypatch, boot, set_by_s, passed_s):
    """Only after a restart of the computer the time of day says how long it was off."""
    _, budget = after_a_play()
    memory.save(budget, DAY_S)
    monkeypatch.setattr(heat_memory, "read_boot", lambda: (boot, DAY_S - 100.0 + set_by_s))
    loaded = memory.load(DAY_S + 1.0 + set_by_s, build_cold_budget_state(16))
    assert loaded.at_s == pytest.approx(budget.at_s - passed_s, abs=1e-6)


def test_damaged_numbers_are_refused_by_name(memory):
    """NaN passes every comparison of the limiter: a third more light was planned than the caps allow."""
    _, budget = after_a_play()
    memory.save(budget, DAY_S)
    with np.load(memory.path) as table:
        sound = {key: table[key] for key in table.files}
    for name in sound.keys() - {"format", "boot"}:
        for damage in (np.full(sound[name].shape, np.nan), np.zeros((3, 3)), np.array("text"), None):
            damaged = {key: value for key, value in (sound | {name: damage}).items() if value is not None}
            np.savez(memory.path, **damaged)
            with pytest.raises(InputError, match=name if name != "rise_k" else "rise_k|pixels"):
                memory.load(DAY_S, build_cold_budget_state(16))


def test_an_unusable_file_is_rejected_by_name(memory):
    _, budget = after_a_play()
    memory.save(budget, DAY_S)
    with pytest.raises(InputError, match=r"Helios-12-3\.npz: pixels: got 16, expected 437"):
        memory.load(DAY_S, build_cold_budget_state(437))
    with pytest.raises(InputError, match="the time of day: got"):
        memory.load(DAY_S - 5.0, build_cold_budget_state(16))
    with memory.path.open("wb") as file:
        np.savez(file, format="optodrive-helios-memory", version=0)
    with pytest.raises(InputError, match="expected optodrive-helios-memory 5"):
        memory.load(DAY_S, build_cold_budget_state(16))
    memory.path.write_bytes(memory.path.read_bytes()[:100])
    with pytest.raises(InputError, match="a file that can be read; remove it once the display has cooled"):
        memory.load(DAY_S, build_cold_budget_state(16))
    memory.path.unlink()
    memory.path.mkdir()
    with pytest.raises(InputError, match="a file that can be written"):
        memory.save(replace(budget), DAY_S)
