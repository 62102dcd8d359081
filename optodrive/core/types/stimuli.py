"""Requested stimuli: tactile frames and pulse trains."""

import struct
from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray, ReadOnlyArrays


@dataclass(frozen=True, eq=False)
class TactileFrame(ReadOnlyArrays):
    """One tactile image: the peak displacement that it requests of each pixel while it is shown.

    target_m: [p] requested peak displacement, m; 0 for inactive pixels
    simultaneous: whether the pixels are raised at the same time instead of one after another
    priority: frames with a higher priority are omitted later if not everything fits
    """

    frame_id: str
    show_at_s: float
    duration_s: float
    target_m: FloatArray
    simultaneous: bool = False
    priority: int = 0


@dataclass(frozen=True)
class PulseTrain:
    """Cyclic stimulation of one pixel by pulses of `pulse_width_s`, separated by `gap_s`, for `duration_s`.

    power_w: incident power while the gate is on, W; priority: as for frames
    The train contains every pulse that starts before its end; the last one may end later.
    """

    pixel: int
    start_s: float
    duration_s: float
    pulse_width_s: float
    gap_s: float
    power_w: float
    priority: int = 0

    def pulse_starts_s(self) -> FloatArray:
        """Return the requested start of each pulse, s, [n]."""
        return _compute_cycle_starts_s(self.start_s, self.duration_s, self.pulse_width_s + self.gap_s)


@dataclass(frozen=True)
class HeightTrain:
    """Cyclic stimulation of one pixel by displacement: a peak of `target_m` every `period_s`, for `duration_s`.

    peak_to_peak_m: fall of the membrane between two peaks, m; None for the smallest possible energy
    priority: as for frames
    Cycles are counted as for a `PulseTrain`; each pulse is planned from the residual heat.
    """

    pixel: int
    start_s: float
    duration_s: float
    period_s: float
    target_m: float
    peak_to_peak_m: float | None = None
    priority: int = 0

    def pulse_starts_s(self) -> FloatArray:
        """Return the requested start of each pulse, s, [n]."""
        return _compute_cycle_starts_s(self.start_s, self.duration_s, self.period_s)


Train = PulseTrain | HeightTrain


def _compute_cycle_starts_s(start_s: float, duration_s: float, period_s: float) -> FloatArray:
    count = max(1, int(np.ceil(duration_s / period_s - 1e-9)))
    return np.asarray(start_s + period_s * np.arange(count), dtype=np.float64)


@dataclass(frozen=True)
class FrameSequence:
    """A request: frames by height and trains by pulse or by height. Times count from the sequence's start."""

    frames: tuple[TactileFrame, ...] = ()
    trains: tuple[Train, ...] = ()


MAGIC = b"ODF1"
HEADER = struct.Struct("<4sI")
HEIGHT_UNIT_M = 1e-7
"""Unit of binary heights, m."""
FRAME_NUMBER_MAX = 0xFFFF_FFFF
