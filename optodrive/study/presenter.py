"""Presentation of stimuli and its interface, and simulated boards in virtual time that present them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from optodrive.core.errors import RefusedError
from optodrive.core.types.arrays import FloatArray, IntArray, ReadOnlyArrays
from optodrive.device.config import Config
from optodrive.link.simulator.virtual_run import START_LEAD_S, VirtualBoards
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.limiter.limiter import shift_state
from optodrive.planning.planned_sequence import PlannedSequence
from optodrive.study.trial_stimulus import IntervalTimes, TrialStimulus

TIME_TOLERANCE_S = 2e-6
"""Rounding of a start to ticks of the board, twice."""
COOLING_STEP_S, COOLING_MAX_S = 5.0, 600.0
"""Step and total of the waiting for a display that is too warm for a stimulus."""


class RequestedStimulus(NamedTuple):
    """A stimulus as it was planned: onset on the board's clock, duration, and largest height.

    height_m: None of a stimulus that is stated by power
    """

    onset_s: float
    duration_s: float
    height_m: float | None

    @classmethod
    def from_plan(cls, onset_s: float, start_s: FloatArray, width_s: FloatArray, target_m: FloatArray) -> Self:
        """Build it from the planned pulses, [n] each. target_m: NaN of a pulse without a requested height."""
        duration_s = float((start_s + width_s).max(initial=0.0) - start_s.min(initial=np.inf)) if len(start_s) else 0.0
        height_m = float(np.nan_to_num(target_m).max(initial=0.0))
        return cls(round(onset_s, 9), round(duration_s, 9), round(height_m, 12) or None)


@dataclass(frozen=True, eq=False)
class Presentation(ReadOnlyArrays):
    """A stimulus as the board reports it, one row per pulse, all arrays [n].

    onset_s: gate on of the first pulse on the board's clock, None if nothing was shown; start_s: counted from it
    fault: how it differs from the request, None if it is as requested; cooling_s: waited for before it
    onset_monotonic_s: onset_s, or the beginning of showing nothing, on the host's CLOCK_MONOTONIC, None of a board in
        virtual time
    intervals: requested times of the parts, counted from the first pulse; silent_end_s: end of a last part that shows
        nothing, else 0
    height_m: largest displacement of any pixel, computed from the executed pulses; None if it is not known
    requested: the same stimulus as it was planned, None if it is not known
    """

    onset_s: float | None
    pixel: IntArray
    start_s: FloatArray
    width_s: FloatArray
    power_w: FloatArray
    fault: str | None
    cooling_s: float = 0.0
    onset_monotonic_s: float | None = None
    intervals: tuple[IntervalTimes, ...] = ()
    silent_end_s: float = 0.0
    height_m: float | None = None
    requested: RequestedStimulus | None = None

    @property
    def duration_s(self) -> float:
        """Time from the first pulse's start to the end of the last one, or of a last part without a pulse, s."""
        return float((self.start_s + self.width_s).max(initial=self.silent_end_s))

    @property
    def end_monotonic_s(self) -> float | None:
        """End of the stimulus on the host's CLOCK_MONOTONIC, s, None of a board in virtual time."""
        return None if self.onset_monotonic_s is None else self.onset_monotonic_s + self.duration_s

    def to_record(self) -> dict[str, Any]:
        """Return the presentation as JSON values."""
        columns = ("pixel", "start_s", "width_s", "power_w")
        pulses = {name: np.round(getattr(self, name), 9).tolist() for name in columns}
        return {
            "onset_s": None if self.onset_s is None else round(self.onset_s, 9),
            "cooling_s": self.cooling_s,
            "duration_s": round(self.duration_s, 6),
            "intervals": [[name, round(start_s, 6), round(end_s, 6)] for name, start_s, end_s in self.intervals],
            "height_m": self.height_m,
            "requested": None if self.requested is None else self.requested._asdict(),
            "executed": pulses,
        }


def place_intervals(stimulus: TrialStimulus, shown: Presentation) -> Presentation:
    """Return a presentation with the times of its stimulus's parts, counted from the first pulse."""
    first_s = stimulus.first_start_s
    intervals = tuple(
        IntervalTimes(each.name, each.start_s - first_s, each.end_s - first_s) for each in stimulus.intervals
    )
    return replace(shown, intervals=intervals, silent_end_s=intervals[-1].end_s if stimulus.has_silent_end else 0.0)


def build_empty_presentation(onset_monotonic_s: float | None) -> Presentation:
    """Return the presentation of nothing. onset_monotonic_s: its beginning."""
    none: FloatArray = np.zeros(0)
    return Presentation(None, np.zeros(0, dtype=np.int64), none, none, none, None, 0.0, onset_monotonic_s)


OnBegin = Callable[[float], None]
"""Gets the time of CLOCK_MONOTONIC at which a stimulus begins, s, before it does."""


def ignore_begin(begin_monotonic_s: float) -> None:
    """Do nothing."""


class Presenter(Protocol):
    """Interface of a display that shows stimuli."""

    @property
    def config(self) -> Config:
        """Configuration of the display."""

    def present(self, stimulus: TrialStimulus, on_begin: OnBegin = ignore_begin) -> Presentation:
        """Show a stimulus and wait for its end. Raise an OptodriveError if it cannot be shown."""

    def wait(self, duration_s: float) -> None:
        """Let time pass between two stimuli."""


class VirtualPresenter:
    """Simulated boards in virtual time. Heat and limits go on from stimulus to stimulus, as in a daemon."""

    def __init__(self, display: DisplayModel) -> None:
        self.display, self.config = display, display.config
        self._boards = VirtualBoards(display.config)
        self._heat, self._budget = display.build_cold_state()
        self._zero_s = self._boards.now_s  # of heat and budget

    def present(self, stimulus: TrialStimulus, on_begin: OnBegin = ignore_begin) -> Presentation:
        """Show a stimulus. Raise RefusedError if the display stays too warm for it, and BoardFaultError."""
        del on_begin  # nobody watches a clock in virtual time
        if stimulus.sequence is None:
            self._boards.wait(stimulus.duration_s)
            return place_intervals(stimulus, build_empty_presentation(None))
        cooling_s = 0.0
        while True:
            shift_s = self._zero_s - self._boards.now_s - START_LEAD_S
            heat, budget = self._heat.copy_shifted(shift_s), shift_state(self._budget, shift_s)
            try:
                planned, _ = check_feasibility(self.display, stimulus.sequence, heat, budget, policy="refuse")
                break
            except RefusedError:
                if cooling_s >= COOLING_MAX_S:
                    raise
                self._boards.wait(COOLING_STEP_S)
                cooling_s += COOLING_STEP_S
        self._zero_s = self._boards.now_s + START_LEAD_S
        self._heat, self._budget = planned.heat, planned.budget
        executed, plan = self._boards.play(planned), planned.plan
        columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
        onset_s = float(executed.on_tick[0]) * self._boards.tick_s if len(executed) else 0.0
        late_s = float(executed.start_s[0] - plan.start_s[0]) if len(executed) else 0.0
        shown = Presentation(
            onset_s,
            executed.pixel,
            executed.start_s - executed.start_s.min(initial=np.inf) if len(executed) else executed.start_s,
            executed.width_s,
            executed.power_w,
            None,
            cooling_s,
            height_m=round(float(heat.copy().apply_pulses(*columns).displacement_m.max(initial=0.0)), 12),
            requested=RequestedStimulus.from_plan(onset_s - late_s, plan.start_s, plan.width_s, plan.target_m),
        )
        fault = find_fault(planned, shown) if executed.complete else "pulses without a report"
        shown = place_intervals(stimulus, replace(shown, fault=fault))
        if shown.silent_end_s > (ended_s := self._boards.now_s - onset_s):
            self._boards.wait(shown.silent_end_s - ended_s)
        return shown

    def wait(self, duration_s: float) -> None:
        """Let virtual time pass."""
        self._boards.wait(duration_s)

    def close(self) -> None:
        """Disarm the simulated boards."""
        self._boards.close()


def find_fault(planned: PlannedSequence, shown: Presentation) -> str | None:
    """Return how executed pulses differ from a plan, None if every pulse is as planned."""
    plan = planned.plan
    if len(plan) != len(shown.pixel):
        return f"{len(shown.pixel)} of {len(plan)} pulses executed"
    if not len(plan):
        return "no pulse"
    if (plan.trimmed_j > 0.0).any():
        return "trimmed by a limit"
    if (plan.pixel != shown.pixel).any():
        return "another order of pixels"
    late_s = np.abs(plan.start_s - plan.start_s[0] - shown.start_s).max()
    if late_s > TIME_TOLERANCE_S:
        return f"a pulse {1e6 * late_s:.0f} µs off its time"
    if not np.allclose(plan.width_s, shown.width_s, rtol=0.0, atol=TIME_TOLERANCE_S):
        return "another pulse width"
    return None
