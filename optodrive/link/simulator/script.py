"""Scripts of a simulated board: input changes, resets and link faults at given times.

[[step]]
at_s = 1.5
set = "interlock"      # or "key", "estop"
value = false

[[step]]
at_s = 2.0
do = "flip_bits"       # or "drop_bytes" (both with rate), "hang", "repair", "reset", "close", "trigger",
                       # "stick_mirror", "slow_mirror", "unplug_mirror"
rate = 0.01

With from = "light", at_s counts from the first pulse; with from = "signal", a step has no at_s, and each SIGUSR1 to the
process carries out the next one. With --sensor also: "stick_x", "stick_y", "invert_readback",
"blind_sensor", "unplug_sensor".
"""

from collections.abc import Collection
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, Literal, get_args

from optodrive.core.errors import MISSING, InputError, suggest_nearest
from optodrive.core.toml_model import read_toml
from optodrive.link.protocol.messages import INPUTS
from optodrive.link.simulator.measured_mirrors import MIRROR_FAULTS

SENSOR_ACTIONS = ("stick_x", "stick_y", "invert_readback", "blind_sensor", "unplug_sensor")
"""Faults of mirrors and spot sensor."""
Origin = Literal["start", "light", "signal"]
ACTIONS = ("flip_bits", "drop_bytes", "hang", "repair", "reset", "close", "trigger", *MIRROR_FAULTS, *SENSOR_ACTIONS)


@dataclass(frozen=True)
class ScriptStep:
    """One step.

    kind: "set" or "do"; name: the input or the action
    origin: what at_s counts from, the start or the first pulse; "signal": the step waits for a signal instead
    """

    at_s: float
    kind: str
    name: str
    value: bool = False
    rate: float = 0.0
    origin: Origin = "start"


def load_script(path: Path, extra_actions: Collection[str] = ()) -> list[ScriptStep]:
    """Load the steps of a script file, sorted by time. extra_actions: actions permitted besides ACTIONS.

    Raise InputError for an unknown key, name or value.
    """
    table = read_toml(path)
    entries = table.pop("step", [])
    for name in table:
        raise InputError(f"{path}", name, "nothing but [[step]]")
    if not isinstance(entries, list):
        raise InputError(f"{path}: step", entries, "[[step]], with two brackets")
    steps = [_parse_step(f"{path}: step {k}", entry, (*ACTIONS, *extra_actions)) for k, entry in enumerate(entries)]
    return sorted(steps, key=lambda step: step.at_s)


def _parse_step(where: str, entry: dict[str, Any], actions: tuple[str, ...]) -> ScriptStep:
    kind = "set" if "set" in entry else "do"
    known = INPUTS if kind == "set" else actions
    name = entry.get(kind, MISSING)
    if not isinstance(name, str) or name not in known:
        raise InputError(f"{where}: {kind}", name, f"a known one, {suggest_nearest(str(name), list(known))}")
    origin = entry.get("from", "start")
    if origin not in get_args(Origin):
        raise InputError(f"{where}: from", origin, "start, light or signal")
    waits = origin == "signal"
    at_s = 0.0 if waits else _parse_number(f"{where}: at_s", entry.get("at_s", MISSING), "a time ≥ 0 in s", inf)
    rate = _parse_number(f"{where}: rate", entry.get("rate", 0.01), "a rate per byte, 0 to 1", 1.0)
    value = entry.get("value", False)
    if not isinstance(value, bool):
        raise InputError(f"{where}: value", value, "true or false")
    allowed = [*(() if waits else ("at_s",)), "from", *(("set", "value") if kind == "set" else ("do", "rate"))]
    for key in entry:
        if key not in allowed:
            raise InputError(where, key, f"a known key, {suggest_nearest(key, allowed)}")
    return ScriptStep(at_s, kind, name, value, rate, origin)


def _parse_number(where: str, value: object, expected: str, max_value: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= max_value:
        raise InputError(where, value, expected)
    return float(value)
