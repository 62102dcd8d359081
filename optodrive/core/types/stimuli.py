"""Requested stimuli: tactile frames and pulse trains."""

from dataclasses import dataclass

import numpy as np

from optodrive.core.types.arrays import FloatArray, freeze_arrays


@dataclass(frozen=True, eq=False)
class TactileFrame:
    """One tactile picture: the peak displacement asked of each pixel while the frame is shown.

    target_m: [p], peak displacement asked for, m; 0 where the pixel is not driven.
    together: the pixels shall stand up at one time rather than one after the other
    priority: the larger, the later it is left out where not everything fits.
    """

    frame_id: str
    show_at_s: float
    duration_s: float
    target_m: FloatArray
    simultaneous: bool = False
    priority: int = 0

    def __post_init__(self) -> None:
        freeze_arrays(self)


@dataclass(frozen=True)
class PulseTrain:
    """Cyclic stimulation of one pixel: pulses of `pulse_width_s` with `gap_s` between, for `duration_s`.

    power_w: incident power while on, W. The train holds every pulse that starts before its end; the last may end later.
    priority: as a frame's.
    """

    pixel: int
    start_s: float
    duration_s: float
    pulse_width_s: float
    gap_s: float
    power_w: float
    priority: int = 0

    def pulse_starts_s(self) -> FloatArray:
        """Nominal start of each pulse, s: [n]."""
        return _compute_cycle_starts_s(self.start_s, self.duration_s, self.pulse_width_s + self.gap_s)


@dataclass(frozen=True)
class HeightTrain:
    """Cyclic stimulation of one pixel by what is felt: a peak of target_m every period_s, for `duration_s`.

    peak_to_peak_m: fall of the membrane between two peaks, m; None for as little energy as possible. Cycles as for a
    `PulseTrain`; each pulse is planned from the heat that is there. priority: as a frame's.
    """

    pixel: int
    start_s: float
    duration_s: float
    period_s: float
    target_m: float
    peak_to_peak_m: float | None = None
    priority: int = 0

    def pulse_starts_s(self) -> FloatArray:
        """Nominal start of each pulse, s: [n]."""
        return _compute_cycle_starts_s(self.start_s, self.duration_s, self.period_s)


Train = PulseTrain | HeightTrain


def _compute_cycle_starts_s(start_s: float, duration_s: float, period_s: float) -> FloatArray:
    count = max(1, int(np.ceil(duration_s / period_s - 1e-9)))
    return np.asarray(start_s + period_s * np.arange(count), dtype=np.float64)


@dataclass(frozen=True)
class FrameSequence:
    """What a caller asks to be felt: frames by height, trains by pulse or by height; times from the plan's start."""

    frames: tuple[TactileFrame, ...] = ()
    trains: tuple[Train, ...] = ()
