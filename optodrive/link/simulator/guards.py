"""Guards before the gate opens: gate-on time, mean power and energy per cell (B4 to B6), in integers only."""

from collections import deque
from dataclasses import dataclass, fields, replace
from pathlib import Path
from re import fullmatch
from typing import Any

from optodrive.core.errors import InputError, suggest_nearest
from optodrive.core.toml_model import read_toml
from optodrive.link.protocol.messages import POINTS_MAX, Limits

DEFAULT_LIMITS = Limits(
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
    settle_us=200,
    settle_ns_per_code=50,
    rest_us=500,
    lease_ms=100,
)
FIELD_MAX = {"H": 0xFFFF, "I": 0xFFFF_FFFF}
SETTING_RANGES = {
    item.name: (0, FIELD_MAX[code]) for item, code in zip(fields(Limits), Limits.LAYOUT.format[1:], strict=True)
}
INTERFACES = ("analog", "xy2-100")
"""How a board tells the mirrors their position."""
CELLS_MAX, WINDOW_PULSES_MAX = 8192, 8192
SETTING_RANGES |= {"cell_codes": (1, 0xFFFF), "queue_points": (POINTS_MAX, 0xFFFF)}
SETTING_RANGES |= {"feedback_codes": (0, 0xFFFF), "cells": (1, CELLS_MAX), "window_pulses": (1, WINDOW_PULSES_MAX)}
UPPER_LIMITS = ("max_on_us", "max_duty", "mean_duty", "spot_uj", "spot_leak_uw", "x_max", "y_max", "lease_ms")
LOWER_LIMITS = ("x_min", "y_min", "settle_us", "settle_ns_per_code", "rest_us")


def tighten(current: Limits, requested: Limits) -> Limits:
    """Return the tighter value of each field. full_power_uw stays as it is."""
    tighter = {name: min(getattr(current, name), getattr(requested, name)) for name in UPPER_LIMITS}
    tighter |= {name: max(getattr(current, name), getattr(requested, name)) for name in LOWER_LIMITS}
    return replace(current, **tighter)


@dataclass(frozen=True)
class BoardSettings:
    """Settings of a simulated board: its own limits, its identity, and the sizes of its guards.

    cell_codes: of a cell, in codes; cells: accounts in each grid; window_pulses: pulses in a second
    interface: one of INTERFACES; the head of a simulated board is always ready
    feedback_codes: a measured position this far from the commanded one is fault SCAN; 0: none is measured
    """

    limits: Limits = DEFAULT_LIMITS
    uid: str = "73696d756c61746564303031"
    cell_codes: int = 1300
    queue_points: int = 4096
    cells: int = 2048
    window_pulses: int = WINDOW_PULSES_MAX
    key_edge: bool = False
    interface: str = "analog"
    feedback_codes: int = 0


def load_settings(path: Path) -> BoardSettings:
    """Load settings from a TOML file: any field of the limits, and of the settings besides.

    Raise InputError for an unknown key or a value out of range.
    """
    table = read_toml(path)
    known = [*SETTING_RANGES, "uid", "key_edge", "interface"]
    for name, value in table.items():
        if name not in known:
            raise InputError(f"{path}", name, f"a known key, {suggest_nearest(name, known)}")
        _check_setting(f"{path}: {name}", name, value)
    return build_settings(table)


def build_settings(table: dict[str, Any]) -> BoardSettings:
    """Return the settings with the values of a table of known keys."""
    limits = replace(DEFAULT_LIMITS, **{name: value for name, value in table.items() if hasattr(DEFAULT_LIMITS, name)})
    return BoardSettings(limits, **{name: value for name, value in table.items() if not hasattr(DEFAULT_LIMITS, name)})


def _check_setting(where: str, name: str, value: object) -> None:
    if name == "uid":
        if not isinstance(value, str) or not fullmatch("[0-9a-fA-F]{24}", value):
            raise InputError(where, value, "24 hexadecimal digits")
    elif name == "interface":
        if value not in INTERFACES:
            raise InputError(where, value, " or ".join(INTERFACES))
    elif name == "key_edge":
        if not isinstance(value, bool):
            raise InputError(where, value, "true or false")
    else:
        low, high = SETTING_RANGES[name]
        if type(value) is not int or not low <= value <= high:
            raise InputError(where, value, f"a whole number from {low} to {high}")


WINDOW_US = 1_000_000
DUTY_FULL = 65535

GRIDS = 4

Cell = tuple[int, int, int]
"""Index of the grid (0 to 3), column, row."""


class EmissionGuards:
    """Accounts of gate-on time, mean power and energy of one board, with times in µs.

    cell_codes: size of a cell; cells: number of accounts in each grid; window_pulses: number of pulses in a second
    """

    def __init__(self, cell_codes: int, cells: int, window_pulses: int) -> None:
        self._cell_codes, self._cells, self._window_pulses = cell_codes, cells, window_pulses
        self._accounts = [0] * GRIDS
        self._on_time: dict[Cell, tuple[int, int]] = {}
        self._bucket: dict[Cell, tuple[int, int]] = {}
        self._recent_pulses: deque[tuple[int, int, int]] = deque()
        self._recent_duty_us = 0

    def find_cells(self, x: int, y: int) -> list[Cell]:
        """Return the cells of a position, one in each of four grids offset by half a cell.

        Two positions less than half a cell apart share a cell in at least one grid, so no cell border separates them
        in all grids; two positions a whole cell apart share none.
        """
        size = self._cell_codes
        half = size // 2
        return [
            (grid, (x - 32768 + shift_x) // size, (y - 32768 + shift_y) // size)
            for grid, (shift_x, shift_y) in enumerate(((half, half), (0, half), (half, 0), (0, 0)))
        ]

    def check_pulse(self, limits: Limits, x: int, y: int, start_us: int, on_us: int, duty: int) -> str:
        """Return the fault that a pulse causes, '' if the guards permit it."""
        cells = self.find_cells(x, y)
        if not all(self._has_room(limits, cell, start_us) for cell in cells):
            return "CELLS"
        if max(self.on_time_us(limits, cell, start_us) for cell in cells) + on_us > limits.max_on_us:
            return "ON_TIME"
        if self.max_window_duty_us(start_us, on_us, duty) > WINDOW_US * limits.mean_duty:
            return "MEAN_POWER"
        level_uj = max(self.bucket_uj(limits, cell, start_us) for cell in cells)
        if level_uj + energy_uj(limits, on_us, duty) > limits.spot_uj:
            return "SPOT"
        return "PULSES" if len(self._recent_pulses) >= self._window_pulses else ""

    def _has_room(self, limits: Limits, cell: Cell, at_us: int) -> bool:
        """Return whether a cell has an account or can have one, that of a cold cell if all are in use."""
        grid = cell[0]
        if cell in self._bucket or self._accounts[grid] < self._cells:
            return True
        for other in [other for other in self._bucket if other[0] == grid]:
            if not self.on_time_us(limits, other, at_us) and not self.bucket_uj(limits, other, at_us):
                del self._bucket[other], self._on_time[other]
                self._accounts[grid] -= 1
        return self._accounts[grid] < self._cells

    def record_pulse(self, limits: Limits, x: int, y: int, start_us: int, on_us: int, duty: int) -> None:
        """Add a pulse to the accounts."""
        energy = energy_uj(limits, on_us, duty)
        for cell in self.find_cells(x, y):
            self._accounts[cell[0]] += cell not in self._bucket
            self._on_time[cell] = self.on_time_us(limits, cell, start_us) + on_us, start_us + on_us
            self._bucket[cell] = self.bucket_uj(limits, cell, start_us) + energy, start_us
        self._recent_pulses.append((start_us, on_us, duty))
        self._recent_duty_us += on_us * duty

    def on_time_us(self, limits: Limits, cell: Cell, at_us: int) -> int:
        """Return the gate-on time of a cell since its last rest, at at_us."""
        on_us, ended_us = self._on_time.get(cell, (0, -WINDOW_US))
        return 0 if at_us - ended_us >= limits.rest_us else on_us

    def bucket_uj(self, limits: Limits, cell: Cell, at_us: int) -> int:
        """Return the level of a cell's leaky bucket, µJ."""
        level_uj, since_us = self._bucket.get(cell, (0, 0))
        return max(0, level_uj - (at_us - since_us) * limits.spot_leak_uw // 1_000_000)

    def max_window_duty_us(self, start_us: int, on_us: int, duty: int) -> int:
        """Return the maximum of gate-on time × duty over any second that contains this pulse, µs × duty code."""
        while self._recent_pulses and sum(self._recent_pulses[0][:2]) <= start_us - WINDOW_US:
            _, old_on_us, old_duty = self._recent_pulses.popleft()
            self._recent_duty_us -= old_on_us * old_duty
        # The sum over a sliding second peaks where the pulse ends, or where an older pulse begins to leave the second.
        window_ends_us = [start_us + on_us]
        for old_start_us, _, _ in self._recent_pulses:
            if old_start_us + WINDOW_US >= start_us + on_us:
                break
            if old_start_us + WINDOW_US > start_us:
                window_ends_us.append(old_start_us + WINDOW_US)
        return max(self._window_duty_us(end_us) + (end_us - start_us) * duty for end_us in window_ends_us)

    def _window_duty_us(self, end_us: int) -> int:
        begin_us, expired_duty_us = end_us - WINDOW_US, 0
        for (
            start_us,
            on_us,
            duty,
        ) in self._recent_pulses:  # oldest first: only the first pulses have left the second
            if start_us >= begin_us:
                break
            expired_duty_us += min(on_us, begin_us - start_us) * duty
        return self._recent_duty_us - expired_duty_us


def energy_uj(limits: Limits, on_us: int, duty: int) -> int:
    """Return the energy of a pulse, µJ, rounded up."""
    return -(-on_us * duty * limits.full_power_uw // (DUTY_FULL * 1_000_000))
