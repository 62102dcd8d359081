"""Quantisation of limited plans to wire points, and decoding of the wire bytes for verification before emission.

x and y are axes of the display everywhere but on the wire: codes along them become those of the outputs X and Y, as
scanner.swap_axes, invert_x and invert_y state the wiring, where points are encoded, and back where they are decoded.
"""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.core.laser_power import ROUNDING, Curve, compute_duty, compute_power_w
from optodrive.core.types.arrays import FloatArray, IntArray, ReadOnlyArrays
from optodrive.core.types.plans import LimitedPlan


@dataclass(frozen=True)
class DacScale:
    """Scale of a digital-to-analogue converter of the mirrors.

    CODE_MAX: largest code; CENTRE_CODE: that of angle 0
    full_power_w, curve: power at full duty and, unless in proportion, at other duties; min_power_w: of a pulse
    swap_axes: output X has the mirror that moves the beam along y; invert_x, invert_y: outputs whose sign is turned
    """

    CODE_MAX: ClassVar[int]
    CENTRE_CODE: ClassVar[int]
    rad_per_code: float
    full_power_w: float
    curve: Curve = field(default=(), kw_only=True)
    min_power_w: float = field(default=0.0, kw_only=True)
    swap_axes: bool = field(default=False, kw_only=True)
    invert_x: bool = field(default=False, kw_only=True)
    invert_y: bool = field(default=False, kw_only=True)

    def __init_subclass__(cls, bits: int) -> None:
        cls.CODE_MAX, cls.CENTRE_CODE = (1 << bits) - 1, 1 << (bits - 1)

    def to_codes(self, angle_rad: FloatArray) -> IntArray:
        """Return the codes of mirror angles, any shape. Raise LocalProtocolError beyond the DAC's range."""
        codes = np.rint(angle_rad / self.rad_per_code).astype(np.int64) + self.CENTRE_CODE
        if codes.size and (codes.min() < 0 or codes.max() > self.CODE_MAX):
            raise LocalProtocolError(f"codes {codes.min()} to {codes.max()} leave the DAC's range 0 to {self.CODE_MAX}")
        return codes

    def to_angles_rad(self, codes: IntArray) -> FloatArray:
        """Return the mirror angles of codes, rad, any shape."""
        return np.asarray((codes - self.CENTRE_CODE) * self.rad_per_code, dtype=np.float64)

    def to_duty(self, power_w: FloatArray) -> FloatArray:
        """Return the duties of mean powers, W, any shape: 0 for less than the weakest pulse."""
        duty = compute_duty(power_w, self.full_power_w, self.curve)
        return np.where(power_w < self.min_power_w * (1.0 - ROUNDING), np.minimum(duty, 0.0), duty)

    def to_power_w(self, duty: FloatArray) -> FloatArray:
        """Return the mean powers of duties, any shape, W."""
        return compute_power_w(duty, self.full_power_w, self.curve)

    def to_outputs(self, x_codes: IntArray, y_codes: IntArray) -> tuple[IntArray, IntArray]:
        """Return the codes of the outputs X and Y for codes along x and y, any shape.

        Raise LocalProtocolError for the code whose inverse lies beyond the DAC's range.
        """
        outputs = (y_codes, x_codes) if self.swap_axes else (x_codes, y_codes)
        x, y = (self._invert(each, turned) for each, turned in zip(outputs, self._inverted, strict=True))
        if any(each.size and each.max() > self.CODE_MAX for each in (x, y)):
            raise LocalProtocolError(f"code 0 has no inverse in the DAC's range 0 to {self.CODE_MAX}")
        return x, y

    def to_axes(self, x_outputs: IntArray, y_outputs: IntArray) -> tuple[IntArray, IntArray]:
        """Return the codes along x and y of codes of the outputs X and Y, any shape."""
        x, y = (self._invert(each, on) for each, on in zip((x_outputs, y_outputs), self._inverted, strict=True))
        return (y, x) if self.swap_axes else (x, y)

    @property
    def _inverted(self) -> tuple[bool, bool]:
        return self.invert_x, self.invert_y

    def _invert(self, codes: IntArray, is_inverted: bool) -> IntArray:
        return 2 * self.CENTRE_CODE - codes if is_inverted else codes


DUTY_MAX = 65535
TICKS_MAX = 65535
PADDING_TICKS = 10_000
GATE_OFF_STEP_TICKS = 60_000
"""A pause longer than one point can hold is split into gate-off points of this length."""


@dataclass(frozen=True)
class WireScale(DacScale, bits=16):
    """Scale factors between SI units and wire integers."""

    tick_s: float


CENTRE_CODE, CODE_MAX = WireScale.CENTRE_CODE, WireScale.CODE_MAX


@dataclass(frozen=True, eq=False)
class WirePoints(ReadOnlyArrays):
    """Points of a plan on the wire.

    table: uint16 [n, 5] of the outputs X and Y, gate-off ticks, gate-on ticks and duty
    row: [n] row of the pulse in the plan, -1 for a point inserted into a long pause or after the last pulse
    """

    table: np.ndarray[tuple[int, ...], np.dtype[np.uint16]]
    row: IntArray

    def __len__(self) -> int:
        return len(self.row)

    def encode_payload(self, first: int = 0, count: int | None = None) -> bytes:
        """Return points first to first + count, or to the last, as the bytes in DATA."""
        return self.table[first : None if count is None else first + count].astype("<u2").tobytes()

    def compute_end_ticks(self) -> IntArray:
        """Return the end of each point in ticks from the plan's zero, [n]."""
        return np.cumsum(self.table[:, 2:4].astype(np.int64).sum(axis=1))

    def count_before(self, row: int) -> int:
        """Return the number of points up to the last pulse before the plan's row `row`."""
        pulses = np.flatnonzero(self.row >= 0)
        count = int(np.searchsorted(self.row[pulses], row))
        return int(pulses[count - 1]) + 1 if count else 0

    def extend(self, end_tick: int) -> Self:
        """Return the points with the gate off behind the last one, until end_tick from the plan's zero.

        The added points are short, so that other points may soon take their place.
        """
        ticks = end_tick - (int(self.compute_end_ticks()[-1]) if len(self) else 0)
        count = -(-ticks // PADDING_TICKS)
        aim = self.table[-1, :2] if len(self) else (CENTRE_CODE, CENTRE_CODE)
        added = np.zeros((count, 5), dtype=np.uint16)
        added[:, :2], added[:, 2] = aim, PADDING_TICKS
        if count:
            added[-1, 2] = ticks - (count - 1) * PADDING_TICKS
        row = np.concatenate([self.row, np.full(count, -1, dtype=np.int64)])
        return type(self)(np.concatenate([self.table, added]), row)

    def add_pause(self, ticks: int) -> Self:
        """Return the points behind a further pause of `ticks`, with the gate off. Gate-off points hold a long one."""
        if not len(self):
            return self
        count = max(0, -(-(int(self.table[0, 2]) + ticks - TICKS_MAX) // GATE_OFF_STEP_TICKS))
        inserted = np.tile(self.table[:1], (count, 1))
        inserted[:, 2:] = GATE_OFF_STEP_TICKS, 0, 0
        table = np.concatenate([inserted, self.table])
        table[count, 2] = int(self.table[0, 2]) + ticks - count * GATE_OFF_STEP_TICKS
        return type(self)(table, np.concatenate([np.full(count, -1, dtype=np.int64), self.row]))


@dataclass(frozen=True, eq=False)
class DecodedPulses:
    """Pulses decoded from wire bytes, all [n]. Times count from the plan's zero. index: position among the points."""

    index: IntArray
    start_s: FloatArray
    width_s: FloatArray
    x_rad: FloatArray
    y_rad: FloatArray
    power_w: FloatArray


def quantise(plan: LimitedPlan, scale: WireScale, stage: int = 0) -> WirePoints:
    """Quantise a stage's pulses of a plan to points.

    Raise LocalProtocolError if a pulse does not fit a point, or pulses overlap.

    Starts are rounded from absolute times, so rounding errors do not accumulate. Duty is rounded down. A pulse trimmed
    to zero power becomes a gate-off point; its mirror position is that of the next pulse with light. The first of such
    points lasts until that pulse begins, because a board ends no point before the mirrors have settled; the others take
    no time. Behind the last light they have the length of their pulses.
    """
    rows = np.flatnonzero(plan.stage == stage)
    start = np.rint(plan.start_s[rows] / scale.tick_s).astype(np.int64)
    width = np.rint(plan.width_s[rows] / scale.tick_s).astype(np.int64)
    # Down, so that no point has more light than was limited; the 1e-12 keeps whole duties whole against rounding.
    duty = np.floor(scale.to_duty(plan.power_w[rows]) * DUTY_MAX * (1 + 1e-12)).astype(np.int64)
    misfits = np.flatnonzero((width > TICKS_MAX) | (width < 1) | (duty > DUTY_MAX) | (duty < 0))
    if len(misfits):
        first = rows[misfits[0]]
        found = f"{plan.width_s[first]:.4g} s at {plan.power_w[first]:.4g} W"
        raise LocalProtocolError(f"a pulse of {found} does not fit a point of the wire")
    next_gate_on = _find_next_gate_on(duty)
    aim_row = rows[next_gate_on]
    x, y = scale.to_outputs(scale.to_codes(plan.x_rad[aim_row]), scale.to_codes(plan.y_rad[aim_row]))
    if len(rows) and (start - np.concatenate([[0], (start + width)[:-1]])).min() < 0:
        raise LocalProtocolError("pulses overlap, or the first begins before the plan")
    end = np.where(next_gate_on > np.arange(len(rows)), start[next_gate_on], start + width)
    # The guards count gate-on time, also at duty 0.
    on_ticks = np.where(duty == 0, 0, width)
    off_ticks = end - on_ticks - np.concatenate([[0], end[:-1]])
    pauses = np.maximum(0, -(-(off_ticks - TICKS_MAX) // GATE_OFF_STEP_TICKS))  # points inserted before each pulse
    last = np.cumsum(pauses + 1) - 1
    point_row = np.repeat(np.arange(len(rows)), pauses + 1)
    table = np.zeros((len(point_row), 5), dtype=np.uint16)
    table[:, 0], table[:, 1], table[:, 2] = x[point_row], y[point_row], GATE_OFF_STEP_TICKS
    table[last, 2] = off_ticks - pauses * GATE_OFF_STEP_TICKS
    table[last, 3], table[last, 4] = on_ticks, duty
    row = np.full(len(point_row), -1, dtype=np.int64)
    row[last] = rows
    return WirePoints(table, row)


def _find_next_gate_on(duty: IntArray) -> IntArray:
    """Return for each row the first row from it on with duty > 0, [n].

    Rows behind the last such row get that row. All rows get 0 if there is none.
    """
    gate_on_rows = np.flatnonzero(duty)
    if not len(gate_on_rows):
        return np.zeros(len(duty), dtype=np.int64)
    return gate_on_rows[np.minimum(np.searchsorted(gate_on_rows, np.arange(len(duty))), len(gate_on_rows) - 1)]


def decode(payload: bytes, scale: WireScale) -> DecodedPulses:
    """Decode the concatenated payloads of DATA frames. Gate-off points only advance time."""
    table = np.frombuffer(payload, dtype="<u2").reshape(-1, 5).astype(np.int64)
    x_output, y_output, off, on, duty = table.T
    x, y = scale.to_axes(x_output, y_output)
    end = np.cumsum(off + on)
    # From the bytes alone, and not from the plan that was encoded.
    gate_on = np.flatnonzero(on > 0)
    return DecodedPulses(
        index=gate_on,
        start_s=np.asarray((end - on)[gate_on] * scale.tick_s, dtype=np.float64),
        width_s=np.asarray(on[gate_on] * scale.tick_s, dtype=np.float64),
        x_rad=scale.to_angles_rad(x[gate_on]),
        y_rad=scale.to_angles_rad(y[gate_on]),
        power_w=scale.to_power_w(duty[gate_on] / DUTY_MAX),
    )
