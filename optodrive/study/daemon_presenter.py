"""Presentation on the display of a running daemon."""

import time
from collections.abc import Mapping

import numpy as np

from optodrive.client.display import Display
from optodrive.client.plan import Plan, report_loss
from optodrive.core.errors import RefusedError
from optodrive.study.presenter import (
    TIME_TOLERANCE_S,
    OnBegin,
    Presentation,
    RequestedStimulus,
    build_empty_presentation,
    ignore_begin,
    place_intervals,
)
from optodrive.study.trial_stimulus import TrialStimulus


class DaemonPresenter:
    """The display behind a daemon whose board is armed already.

    labels: recorded with every plan
    """

    def __init__(self, display: Display, labels: Mapping[str, str | int | float | bool]) -> None:
        self._display, self._labels, self.config = display, labels, display.config()

    def present(self, stimulus: TrialStimulus, on_begin: OnBegin = ignore_begin) -> Presentation:
        """Play a stimulus and wait for its end. Raise the daemon's error if it is refused or fails.

        Raise RefusedError if the daemon runs on another computer: response times need one clock.
        """
        called_s = time.monotonic()
        if stimulus.sequence is None:
            on_begin(called_s)
            time.sleep(stimulus.duration_s)
            return place_intervals(stimulus, build_empty_presentation(called_s))
        plan = self._display.push(stimulus.to_body(), labels=self._labels, policy="refuse", wait=False)
        if plan.onset is not None:
            on_begin(plan.onset.monotonic_s - stimulus.first_start_s)
        with report_loss(plan.plan):
            plan = self._display.wait(plan)
        if plan.onset is not None and not called_s <= plan.onset.monotonic_s <= time.monotonic():
            raise RefusedError("the daemon's clock is not that of this computer: run the study where the daemon runs")
        columns = plan.executed_pulses
        start_s = np.asarray([] if columns is None else columns.start_s, dtype=np.float64)
        shown = Presentation(
            onset_s=0.0 if plan.onset is None else plan.onset.board_s,
            pixel=np.asarray([] if columns is None else columns.pixel, dtype=np.int64),
            start_s=start_s - start_s.min(initial=np.inf) if len(start_s) else start_s,
            width_s=np.asarray([] if columns is None else columns.width_s, dtype=np.float64),
            power_w=np.asarray([] if columns is None else columns.power_w, dtype=np.float64),
            fault=find_fault(plan),
            onset_monotonic_s=None if plan.onset is None else plan.onset.monotonic_s,
            height_m=None if columns is None or not columns.simulated_um else 1e-6 * max(columns.simulated_um),
            requested=_describe_request(plan),
        )
        shown = place_intervals(stimulus, shown)
        if shown.silent_end_s and shown.onset_monotonic_s is not None:
            self.wait(max(0.0, shown.onset_monotonic_s + shown.silent_end_s - time.monotonic()))
        return shown

    def wait(self, duration_s: float) -> None:
        """Wait by the computer's clock."""
        time.sleep(duration_s)


def _describe_request(plan: Plan) -> RequestedStimulus | None:
    """Return the stimulus as it was planned, None if its pulses are not known."""
    planned, executed = plan.pulses, plan.executed_pulses
    if plan.onset is None or planned is None or executed is None or not executed.start_s or not planned.start_s:
        return None
    onset_s = plan.onset.board_s - (executed.start_s[0] - planned.start_s[0])
    target_m = 1e-6 * np.array([np.nan if target_um is None else target_um for target_um in planned.target_um])
    return RequestedStimulus.from_plan(onset_s, np.asarray(planned.start_s), np.asarray(planned.width_s), target_m)


def find_fault(plan: Plan) -> str | None:
    """Return how a plan's executed pulses differ from those planned, None if every one is as planned."""
    planned, executed = plan.pulses, plan.executed_pulses
    if executed is None or not plan.executed_complete or plan.executed != plan.planned:
        return f"{plan.executed} of {plan.planned} pulses executed"
    if plan.onset is None:
        return "the board's clock is not synchronised: the time of the onset is not known"
    if plan.summary.trimmed.pulses:
        return f"{plan.summary.trimmed.pulses} pulses trimmed by a limit"
    if planned is None:
        return "too many pulses to be compared"
    if list(planned.pixel) != list(executed.pixel):
        return "another order of pixels"
    late_s = np.abs(np.asarray(planned.start_s) - planned.start_s[0] - executed.start_s + executed.start_s[0]).max()
    if late_s > TIME_TOLERANCE_S:
        return f"a pulse {1e6 * late_s:.0f} µs off its time"
    if not np.allclose(planned.width_s, executed.width_s, rtol=0.0, atol=TIME_TOLERANCE_S):
        return "another pulse width"
    return None
