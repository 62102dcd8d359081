"""Registry of scenarios, their execution, and the audit of a board's log."""

import tempfile
import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from bench import Bench

TABLE = tomllib.loads((Path(__file__).parents[2] / "firmware_protocol" / "messages.toml").read_text())
TRANSITIONS = {(state, entry["event"], entry["to"]) for entry in TABLE["transition"] for state in entry["from"]}
AT_ONCE = 4
"""Scenarios in real time, which mostly wait for the two seconds of arming."""
TICK_US = 100
"""The longest period of a board's tick, which carries out what is due."""
AT_ONCE_BY = ("abort", "disarm", "flush", "hello", "link lost", "reset")
GUARDS = [f"B{k}" for k in range(1, 18)]


class Scenario(NamedTuple):
    """One requirement. subject: B1 to B17, or a section of PROTOCOL.md."""

    subject: str
    name: str
    module: str
    play: Callable[[Bench], Any]


SCENARIOS: list[Scenario] = []


def scenario(subject, cases=None):
    """Register a function of a bench. With cases (a dict by name), it runs once per case as its second argument."""

    def register(function):
        name, module = function.__name__, function.__module__
        if cases is None:
            SCENARIOS.append(Scenario(subject, name, module, function))
        for label, case in (cases or {}).items():
            with_case = Scenario(subject, f"{name}-{label}", module, lambda bench, case=case: function(bench, case))
            SCENARIOS.append(with_case)
        return function

    return register


def judge(kind, case: Scenario):
    """Run a scenario once against a board of a kind. Raise AssertionError if the board does not conform."""
    with tempfile.TemporaryDirectory(prefix="conform-") as folder:
        bench = Bench(kind, folder)
        try:
            case.play(bench)
        except BaseException:
            bench.finish(unseen)
            raise
        bench.finish(audit)


def unseen(board):
    """Ignore the log of a board that has already failed."""


def audit(board):
    """Check the log of a stopped board."""
    audit_log(board.events())
    audit_output(board.of("gate"), board.output_edges())


def audit_log(events, state="BOOT"):
    """Check transitions, gate on only in RUNNING, and two edges per pulse. state: before the log."""
    gate, since, pulsed = False, None, []
    for entry in events:
        if entry["event"] == "state":
            assert entry["before"] in (state, "BOOT"), entry  # a reset passes BOOT without an entry
            assert (entry["before"], entry["reason"], entry["state"]) in TRANSITIONS, f"no transition: {entry}"
            state = entry["state"]
            assert not gate or state == "RUNNING", f"lit in {entry}"
        elif entry["event"] == "gate":
            assert entry["on"] != gate, f"an edge that is none: {entry}"
            assert state == "RUNNING", f"an edge in {state}: {entry}"
            gate = entry["on"]
            if gate:
                since = entry
            else:
                pulsed.append((since["reason"], since["t_us"], entry["t_us"]))
    assert not gate, "lit when it ended"
    reported = [entry for entry in events if entry["event"] == "pulse"]
    pulses = [(f"point {entry['index']}", entry["on_us"], entry["off_us"]) for entry in reported]
    shown = set(pulses)
    assert [edge for edge in pulsed if edge in shown] == pulses, "pulses that the gate does not show"


def audit_output(logged, edges):
    """Check that each edge of the output follows the logged one: at once if the host or a reset ends a pulse."""
    assert [on for _, on in edges] == [entry["on"] for entry in logged], "edges that the log does not show"
    for entry, (at_us, _) in zip(logged, edges, strict=True):
        late_max_us = 0 if entry["reason"] in AT_ONCE_BY else TICK_US
        assert 0 <= at_us - entry["t_us"] <= late_max_us, f"output at {at_us} µs: {entry}"


def run_all(kind, cases: list[Scenario]):
    """Start all scenarios with limited concurrency. Return their futures by name."""
    pool = ThreadPoolExecutor(AT_ONCE)
    futures = {case.name: pool.submit(judge, kind, case) for case in cases}
    pool.shutdown(wait=False)
    return futures
