"""What happens to a simulated board at given times: inputs change, it is reset, its link breaks down.

[[step]]
at_s = 1.5
set = "interlock"      # or "key", "estop"
value = false

[[step]]
at_s = 2.0
do = "flip_bits"       # or "drop_bytes" (both with rate), "hang", "repair", "reset", "close"
rate = 0.01
"""

from dataclasses import dataclass
from pathlib import Path

from optodrive.config import read_toml
from optodrive.errors import InputError, nearest
from optodrive.wire.messages import INPUTS

ACTIONS = ("flip_bits", "drop_bytes", "hang", "repair", "reset", "close")


@dataclass(frozen=True)
class Step:
    """One thing that happens. kind: "set" or "do"; name: the input or the action."""

    at_s: float
    kind: str
    name: str
    value: bool = False
    rate: float = 0.0


def load_script(path: Path) -> list[Step]:
    """The steps of a script file in order of time; InputError for what it cannot mean."""
    steps = []
    for k, entry in enumerate(read_toml(path).get("step", [])):
        where = f"{path}: step {k}"
        at_s = entry.get("at_s")
        if not isinstance(at_s, int | float) or at_s < 0:
            raise InputError(f"{where}: at_s", at_s, "a time ≥ 0 in s")
        kind = "set" if "set" in entry else "do"
        known = INPUTS if kind == "set" else ACTIONS
        name = entry.get(kind)
        if name not in known:
            raise InputError(f"{where}: {kind}", name, f"a known one, {nearest(str(name), list(known))}")
        steps.append(Step(float(at_s), kind, name, bool(entry.get("value", False)), float(entry.get("rate", 0.01))))
    return sorted(steps, key=lambda step: step.at_s)
