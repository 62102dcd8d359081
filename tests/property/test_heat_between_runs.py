"""No run on a board makes a surface too warm that earlier runs have warmed: daemons and commands, killed or not.

The judge integrates the light of all runs by itself.
"""

import os
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heat_world import DISPLAY, NOBODY, UIDS, new_world
from optodrive.daemon.engine import kept_heat
from optodrive.planning import heat_record
from optodrive.planning.heat_record import HeatRecord

ENDS = ("stopped", "stopped", "killed", "interrupted")
USERS = (0, NOBODY) if os.geteuid() == 0 else (0,)
FAULTS = ("restart", "lose", "lose all", "cut", "back up", "restore")
STEPS = st.one_of(
    st.tuples(
        st.just("run"),
        st.sampled_from(("serve", "bench")),
        st.sampled_from(ENDS),
        st.floats(0.1, 3.0),
        st.sampled_from(USERS),
    ),
    st.tuples(st.just("do"), st.sampled_from(FAULTS)),
    st.tuples(st.just("pass_time"), st.sampled_from([0.5, 5.0, 40.0])),
)


def check_sequence(steps):
    with new_world() as world:
        world.record_cold()
        world.run("serve")
        for name, *values in steps:
            getattr(world, name)(*values)
        world.run("serve")
        assert world.judge() <= 0.0


@settings(max_examples=5, deadline=None)
@given(st.lists(STEPS, min_size=1, max_size=4))
def test_no_surface_passes_its_cap(steps):
    check_sequence(steps)


@pytest.mark.slow
@pytest.mark.timeout(0)
@settings(max_examples=200, deadline=None)
@given(st.lists(STEPS, min_size=2, max_size=10))
def test_no_surface_passes_its_cap_in_long_sequences(steps):
    check_sequence(steps)


SCRIPTS = {
    "daemons": [],
    "a killed daemon": [("run", "serve", "killed", 3.0)],
    "a terminated daemon": [("run", "serve", "interrupted", 3.0)],
    "a command": [("run", "bench")],
    "a killed command": [("run", "bench", "killed", 3.0)] * 2,
    "an interrupted command": [("run", "bench", "interrupted", 2.0)],
    "another user": [("run", "serve", "stopped", 0.0, USERS[-1])],
    "another display's record": [("record_cold", UIDS[1])],
    "lost": [("do", "lose")],
    "restored": [("do", "restore")],
    "restarted": [("do", "restart")],
}


def run_script(steps, mutate=lambda: None):
    """Return by how much a surface has passed its cap, K, and the share of light in the last run."""
    with new_world() as world:
        world.record_cold()
        world.do("back up")
        mutate()
        world.run("serve")
        cold_j = world.count_light_j()
        for name, *values in steps:
            getattr(world, name)(*values)
        before_j = world.count_light_j()
        world.run("serve")
        return world.judge(), (world.count_light_j() - before_j) / cold_j


ENDED_IN_ORDER = ("daemons", "a terminated daemon", "a command", "an interrupted command")


@pytest.mark.parametrize("script", SCRIPTS)
def test_what_may_have_warmed_the_display_counts(script):
    """What has ended in order leaves a display that is not hot: a hot one gets no light at first."""
    beyond_k, light_share = run_script(SCRIPTS[script])
    assert beyond_k <= 0.0
    assert light_share > 0.5 or script not in ENDED_IN_ORDER


def test_a_run_that_records_nothing_at_its_end_is_caught(monkeypatch):
    """Mutant: only the begin of a use is recorded."""
    skip = partial(monkeypatch.setattr, HeatRecord, "save", lambda *_: None)
    assert run_script(SCRIPTS["daemons"], skip)[1] < 0.5


def _accept_all_boards(patch):
    for module in (heat_record, kept_heat):
        patch.setattr(module, "join_uids", lambda uids, is_part=False: "any")
    enter = HeatRecord.open

    def open_any(record):
        record._identity, record._name = "any", "board-any"
        return enter(record)

    patch.setattr(HeatRecord, "open", open_any)


MUTANTS = {
    "daemons": lambda patch: patch.setattr(HeatRecord, "load", lambda record: DISPLAY.build_cold_state()[1]),
    "a killed daemon": lambda patch: patch.setattr(HeatRecord, "begin_use", lambda record: None),
    "a killed command": lambda patch: patch.setattr(HeatRecord, "begin_use", lambda record: None),
    "another display's record": _accept_all_boards,
    "lost": lambda patch: patch.setattr(heat_record, "build_hot_budget_state", lambda cold, budget: cold),
    "restored": lambda patch: patch.setattr(HeatRecord, "_judge", lambda record, file: None),
}


@pytest.mark.parametrize("script", MUTANTS)
def test_a_program_that_forgets_is_caught(script, monkeypatch):
    """Mutants: every run is cold, a killed one left no trace, another board's record or an old copy counts."""
    MUTANTS[script](monkeypatch)
    assert run_script(SCRIPTS[script])[0] > 0.0
