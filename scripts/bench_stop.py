"""STOP: time from sending it to dark by the board's log, at rest and under each flood of a caller.

Show, floods and STOPs share this computer, so each time is an upper bound: part of it is the wait for a core.
"""

import sys
import tempfile
import time
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path

import httpx
from measuring import Row, Sleeper, realtime_priority, time_limit, to_ms

from floods import FLOODS  # of the tests
from rig import read_role_tokens
from stop_rig import FloodProcess, StopRig, is_gate_on, is_unarmed

ANSWER_MAX_S = 60.0
"""A STOP without an answer for this time counts as one."""
BEGIN_MAX_S = 30.0
"""Longest wait for the light of a show. A flood that keeps one from beginning is a result, too."""
END_MAX_S = 30.0
OPTIONS = {
    "floods": {"nargs": "*", "metavar": "FLOOD", "help": f"rest, {', '.join(FLOODS)}; all by default"},
    "--stops": {"type": int, "default": 40, "help": "STOPs under each flood"},
    "--seconds": {"type": float, "default": 40.0, "help": "longest time of each flood"},
    "--watch-s": {"type": float, "default": 6.0, "help": "time of a show without STOP, first"},
    "--lease-s": {"type": float, "default": 0.1, "help": "lease; the shipped one by default"},
    "--path": {"default": "http", "choices": ("http", "socket"), "help": "way of STOP"},
}
GIVEN_UP = (OSError, AssertionError, httpx.HTTPError)


@dataclass
class FloodResult:
    """Results of shows and their STOPs under a flood.

    gate_off_s: from sending STOP to the board's abort; answered_s: from sending STOP to the first byte of its answer
    reference_s: times of the reference, measured before each STOP
    darkened: faults and underruns that were not STOP's doing; relit: pulses after a STOP and before the next arming
    log: what the daemon wrote to its log meanwhile
    """

    name: str
    gate_off_s: list[float] = field(default_factory=list)
    answered_s: list[float] = field(default_factory=list)
    reference_s: list[float] = field(default_factory=list)
    darkened: list[str] = field(default_factory=list)
    relit: int = 0
    not_begun: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)


def start_show(rig):
    """Begin a show and return the index of its first event, None if that fails twice."""
    for _ in range(2):
        with suppress(*GIVEN_UP), time_limit(BEGIN_MAX_S):
            return rig.start_show()
    return None


def watch_show(rig, result, begin, duration_s):
    """Let the show that began at an event run for a time, note its darkenings, and return whether it is lit."""
    until_s = time.monotonic() + duration_s
    while time.monotonic() < until_s and not rig.find_darkness(begin):
        time.sleep(0.05)
    darkened = rig.find_darkness(begin)
    if darkened:
        result.darkened += darkened
        with suppress(*GIVEN_UP), time_limit(ANSWER_MAX_S):
            rig.client.post("/v1/stop")
    return not darkened


def stop_show(rig, result, begin, send):
    """Send STOP to the show that began at an event, and note when the board was dark for good."""
    sent_s = time.monotonic()
    try:
        with time_limit(ANSWER_MAX_S):
            result.answered_s.append(send() - sent_s)
    except GIVEN_UP:
        result.answered_s.append(ANSWER_MAX_S)
    try:
        with time_limit(ANSWER_MAX_S):
            end = rig.tail.find(is_unarmed, begin, "the board to be unarmed")
    except TimeoutError:
        result.gate_off_s.append(ANSWER_MAX_S)
        return
    if end["state"] == "FAULT":
        result.darkened += rig.find_darkness(begin)
    result.gate_off_s.append(max(0.0, rig.to_host_s(end) - sent_s))
    result.relit += sum(map(is_gate_on, rig.tail.events[rig.tail.events.index(end) :]))


def run_flood(rig, name, stops=20, seconds=60.0, watch_s=0.0, path="http", measure_reference=None):
    """Run a flood over a show that is on already, then STOP it and further shows.

    name: of the flood; "rest" for none. watch_s: time of the first show before its STOP. stops: how many, or as many as
    `seconds` allow; no more once two shows in a row did not begin. measure_reference: returns a time, s, called before
    each STOP. Returns the FloodResult.
    """
    result, send = FloodResult(name), rig.senders[path]
    begin = start_show(rig)
    if begin is None:
        raise SystemExit("the first show did not begin, before the flood")
    with time_limit(BEGIN_MAX_S):
        flood = None if name == "rest" else FloodProcess(name, rig.daemon.url, read_role_tokens(rig.daemon))
    try:
        until_s, failed, round_s = time.monotonic() + seconds, 0, watch_s
        for k in range(stops):
            if begin is not None and watch_show(rig, result, begin, round_s):
                if measure_reference is not None:
                    result.reference_s.append(measure_reference())
                with nullcontext() if flood is None else flood.triggered():
                    stop_show(rig, result, begin, send)
            if k + 1 == stops or time.monotonic() > until_s or failed == 2:
                break
            begin, round_s = start_show(rig), 0.02 + 0.013 * (k % 17)
            failed = failed + 1 if begin is None else 0
            result.not_begun += begin is None
    finally:
        if flood is not None:
            with time_limit(END_MAX_S):
                result.counts = flood.finish()
    result.log = rig.daemon.errors.read_text().splitlines()
    return result


def count_items(items):
    """Return the number of each distinct item, as text."""
    return ", ".join(f"{items.count(item)} {item}" for item in dict.fromkeys(items)) or "no"


def measure(floods=(), stops=40, seconds=40.0, watch_s=6.0, lease_s=0.1, path="http"):
    unknown = [name for name in floods if name not in FLOODS and name != "rest"]
    if unknown:
        raise SystemExit(f"FLOOD: got {unknown[0]!r}, expected one of rest, {', '.join(FLOODS)}")
    for name in floods or ("rest", *FLOODS):
        sleeper = Sleeper(is_realtime=True)
        try:
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
                rig = StopRig(Path(folder), lease_s=lease_s)
                try:
                    with realtime_priority():  # the time of STOP must not include the wait of this process for a core
                        result = run_flood(rig, name, stops, seconds, watch_s, path)
                finally:
                    rig.close()
        finally:
            late_s = sleeper.finish()
        yield Row(f"STOP to gate off, {name}", to_ms(result.gate_off_s), late_s=late_s)
        yield Row(f"STOP to its answer, {name}", to_ms(result.answered_s), late_s=late_s)
        yield f"{name}: shows not begun", result.not_begun, "1"
        yield f"{name}: pulses after STOP", result.relit, "1"
        outcomes = sorted(result.counts.items(), key=lambda item: -item[1])[:4]
        yield f"{name}: {count_items(result.darkened)} darkened; outcomes {dict(outcomes)}"
        if result.darkened:
            print("\n".join(result.log[-10:]), file=sys.stderr, flush=True)
