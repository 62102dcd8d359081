"""A board's limits: its own, read from a file, and those a host tightened them to."""

from dataclasses import dataclass, fields, replace
from pathlib import Path

from optodrive.config import read_toml
from optodrive.errors import InputError, nearest
from optodrive.wire.messages import Limits

OWN = Limits(
    max_on_us=50_000,
    max_duty=65535,
    mean_duty=65535,
    spot_uj=150_000,
    spot_leak_uw=1_400_000,
    full_power_uw=2_450_000,
    x_min=0,
    x_max=65535,
    y_min=0,
    y_max=65535,
    settle_us=250,
    settle_ns_per_code=50,
    rest_us=500,
    lease_ms=100,
)
LOOSENED_BY_MORE = ("max_on_us", "max_duty", "mean_duty", "spot_uj", "spot_leak_uw", "x_max", "y_max", "lease_ms")
LOOSENED_BY_LESS = ("x_min", "y_min", "settle_us", "settle_ns_per_code", "rest_us")


def tightened(own: Limits, asked: Limits) -> Limits:
    """The tighter of both, field by field; the board's power is its own."""
    tighter = {name: min(getattr(own, name), getattr(asked, name)) for name in LOOSENED_BY_MORE}
    tighter |= {name: max(getattr(own, name), getattr(asked, name)) for name in LOOSENED_BY_LESS}
    return replace(own, **tighter)


@dataclass(frozen=True)
class BoardSettings:
    """What a simulated board is: limits, identity, the grid of cells that its spot guards watch."""

    limits: Limits = OWN
    uid: str = "73696d756c61746564303031"
    cell_codes: int = 1300
    queue_points: int = 4096
    key_edge: bool = False


def load_settings(path: Path) -> BoardSettings:
    """Settings from a TOML file: any field of the limits, and uid, cell_codes, queue_points, key_edge."""
    table = read_toml(path)
    limit_names = [item.name for item in fields(Limits)]
    other_names = [item.name for item in fields(BoardSettings) if item.name != "limits"]
    for name, value in table.items():
        if name not in limit_names + other_names:
            raise InputError(f"{path}", name, f"a known key, {nearest(name, limit_names + other_names)}")
        if name in limit_names and (not isinstance(value, int) or not 0 <= value < 2**32):
            raise InputError(f"{path}: {name}", value, "a whole number that fits its field")
    limits = replace(OWN, **{name: value for name, value in table.items() if name in limit_names})
    return BoardSettings(limits, **{name: value for name, value in table.items() if name in other_names})
