"""Limited plans to points of codes and ticks, and the very bytes back to SI, for the proof before emission."""

from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.arrays import FloatArray, IntArray, freeze_arrays
from optodrive.core.types.plans import LimitedPlan
from optodrive.link.protocol.dac_codes import Converter

DAC = Converter(16)
CENTRE_CODE, CODE_MAX = DAC.centre, DAC.code_max
DUTY_MAX = 65535
TICKS_MAX = 65535
DARK_STEP_TICKS = 60_000
"""A pause longer than a point can hold is cut into dark points of this length."""


@dataclass(frozen=True)
class WireScale:
    """How SI becomes codes and ticks."""

    rad_per_code: float
    full_power_w: float
    tick_s: float

    def codes(self, angle_rad: FloatArray) -> IntArray:
        """Mirror angle to DAC codes; LocalProtocolError beyond the DAC's range. Any shape."""
        return DAC.codes(angle_rad, self.rad_per_code)

    def angles(self, codes: IntArray) -> FloatArray:
        """DAC codes to mirror angle, rad. Any shape."""
        return DAC.angles(codes, self.rad_per_code)


@dataclass(frozen=True, eq=False)
class WirePoints:
    """Points of a plan: table uint16 [n, 5] of x, y, dark, on, duty; row [n] the plan's pulse, -1 for a dark point."""

    table: np.ndarray[tuple[int, ...], np.dtype[np.uint16]]
    row: IntArray

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __len__(self) -> int:
        return len(self.row)

    def payload(self, first: int = 0, count: int | None = None) -> bytes:
        """The bytes of points first to first + count, or to the last, as DATA carries them."""
        return self.table[first : None if count is None else first + count].astype("<u2").tobytes()

    def ends(self) -> IntArray:
        """When each point ends, ticks from the plan's zero, [n]."""
        return np.cumsum(self.table[:, 2:4].astype(np.int64).sum(axis=1))

    def up_to(self, row: int) -> int:
        """How many points there are before the darkness that leads to the plan's pulse `row`."""
        return int(np.searchsorted(np.maximum.accumulate(self.row), row - 1)) + 1 if row else 0


@dataclass(frozen=True, eq=False)
class DecodedPulses:
    """Pulses read back from bytes, times from the plan's zero; all [n]. index counts the points from the first."""

    index: IntArray
    start_s: FloatArray
    width_s: FloatArray
    x_rad: FloatArray
    y_rad: FloatArray
    power_w: FloatArray


def quantise(plan: LimitedPlan, scale: WireScale) -> WirePoints:
    """Points for a plan. Starts come from absolute times, so rounding never adds up; duty is rounded down.

    A pulse trimmed to nothing becomes a dark point of the same length, so that times stay; the mirrors do not go there
    but on to the next pulse.
    """
    start = np.rint(plan.start_s / scale.tick_s).astype(np.int64)
    width = np.rint(plan.width_s / scale.tick_s).astype(np.int64)
    duty = np.floor(plan.power_w / scale.full_power_w * DUTY_MAX * (1 + 1e-12)).astype(np.int64)
    if len(plan) and (width.max() > TICKS_MAX or width.min() < 1 or duty.max() > DUTY_MAX or duty.min() < 0):
        raise LocalProtocolError("a pulse does not fit a point of the wire")
    goal = _next_lit(duty)
    x, y = scale.codes(plan.x_rad[goal]), scale.codes(plan.y_rad[goal])
    dark = start - np.concatenate([[0], (start + width)[:-1]])
    if len(plan) and dark.min() < 0:
        raise LocalProtocolError("pulses overlap, or the first begins before the plan")
    table: list[tuple[int, int, int, int, int]] = []
    rows: list[int] = []
    columns = (x.tolist(), y.tolist(), dark.tolist(), width.tolist(), duty.tolist())
    for row, (x_code, y_code, dark_ticks, on_ticks, duty_code) in enumerate(zip(*columns, strict=True)):
        if duty_code == 0:
            dark_ticks, on_ticks = dark_ticks + on_ticks, 0
        while dark_ticks > TICKS_MAX:
            table.append((x_code, y_code, DARK_STEP_TICKS, 0, 0))
            rows.append(-1)
            dark_ticks -= DARK_STEP_TICKS
        table.append((x_code, y_code, dark_ticks, on_ticks, duty_code))
        rows.append(row)
    return WirePoints(np.array(table, dtype=np.uint16).reshape(-1, 5), np.array(rows, dtype=np.int64))


def _next_lit(duty: IntArray) -> IntArray:
    """[n] the row itself where it is lit, else the next lit row, or the last; the first where none is lit."""
    lit = np.flatnonzero(duty)
    if not len(lit):
        return np.zeros(len(duty), dtype=np.int64)
    return lit[np.minimum(np.searchsorted(lit, np.arange(len(duty))), len(lit) - 1)]


def decode(payload: bytes, scale: WireScale) -> DecodedPulses:
    """Read points back from the bytes of DATA frames, joined in order; dark points only pass time."""
    table = np.frombuffer(payload, dtype="<u2").reshape(-1, 5).astype(np.int64)
    x, y, dark, on, duty = table.T
    end = np.cumsum(dark + on)
    lit = np.flatnonzero(on > 0)
    return DecodedPulses(
        index=lit,
        start_s=np.asarray((end - on)[lit] * scale.tick_s, dtype=np.float64),
        width_s=np.asarray(on[lit] * scale.tick_s, dtype=np.float64),
        x_rad=scale.angles(x[lit]),
        y_rad=scale.angles(y[lit]),
        power_w=duty[lit] / DUTY_MAX * scale.full_power_w,
    )
