"""The two processes that compile the limiter where its machine code is not cached."""

import os
import pickle
import subprocess
import sys

import pytest

from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter import pulse_application
from optodrive.planning.limiter.cap_checks import max_power_w
from optodrive.planning.limiter.pulse_application import BEFORE, REQUEST, ColdStart
from optodrive.planning.limiter.workspace import open_workspace

PLAN = """
import sys
from numba.core import event

class Names(event.Listener):
    def __init__(self):
        self.compiled = set()
    def on_start(self, data):
        self.compiled.add(data.data["dispatcher"].py_func.__name__)
    def on_end(self, data):
        pass

names = Names()
event.register("numba:compile", names)
from optodrive.cli.main import run
assert run(["plan", "--config", "display-1", sys.argv[1]]) == 0
print(*sorted(names.compiled))
"""


@pytest.fixture
def display():
    return DisplayModel.from_config(load_config("display-1"))


def test_the_second_process_compiles_for_the_very_types(monkeypatch, display, tmp_path):
    """An array that became writable on the way would be another type, whose machine code nobody uses."""
    program, sent = tmp_path / "program", tmp_path / "sent"
    program.write_text(f"#!/bin/sh\ncat > {sent}\n")
    program.chmod(0o700)
    monkeypatch.setattr(pulse_application, "is_cached", lambda kernel: False)
    monkeypatch.setattr(pulse_application.sys, "executable", str(program))
    start, (_, budget_state) = ColdStart(), display.build_cold_state()
    start.begin(display.budget, budget_state)
    start.finish(display.budget, budget_state)
    max_power_w.compile(pickle.loads(sent.read_bytes()))
    count = len(max_power_w.signatures)
    max_power_w(display.budget, open_workspace(budget_state, 1), REQUEST, BEFORE)
    assert len(max_power_w.signatures) == count


@pytest.mark.parametrize("program", ["/bin/true", "/bin/false"])
def test_a_second_process_that_fails_costs_nothing_but_time(monkeypatch, display, program):
    monkeypatch.setattr(pulse_application, "is_cached", lambda kernel: False)
    monkeypatch.setattr(pulse_application.sys, "executable", program)
    start = ColdStart()
    _, budget_state = display.build_cold_state()
    start.begin(display.budget, budget_state)
    start.finish(display.budget, budget_state)


@pytest.mark.slow
def test_a_first_plan_leaves_half_of_the_limiter_to_a_second_process(tmp_path):
    frames = tmp_path / "frames.json"
    frames.write_text('{"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"0": 50}}]}')
    ended = subprocess.run(
        [sys.executable, "-c", PLAN, frames],
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stderr
    compiled = set(ended.stdout.splitlines()[-1].split())
    assert {"apply_pulses", "compute_start_state"} <= compiled
    assert not compiled & {"max_power_w", "slow_node_limits_w"}
