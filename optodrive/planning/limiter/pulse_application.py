"""Apply the pulses of a plan to the limiter's workspace, each as far as the caps allow. Kernels."""

import pickle
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numba

from optodrive.core.child_process import die_with_parent
from optodrive.core.kernels import CACHED, is_cached, kernel
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.core.types.plans import BudgetState
from optodrive.planning.limiter.budget import TOLERANCE, Budget
from optodrive.planning.limiter.cap_checks import PixelStartState, absorber_peak_k, max_power_w
from optodrive.planning.limiter.caps import NO_CAP
from optodrive.planning.limiter.galvo_load import galvo_after_move, is_move, store_move
from optodrive.planning.limiter.heat_bound import (
    absorber_after_k,
    advance_pixel,
    exchange_wall_heat,
    lower_bound_after_k,
    panel_peak_k,
    panel_rise_by_others_k,
    touch_after_k,
    wall_after_k,
    warm_panel,
)
from optodrive.planning.limiter.slow_nodes import PulseRequest, wall_credited_peak_k
from optodrive.planning.limiter.workspace import LimiterWorkspace, append, open_workspace

TRIM, STOP, COUNT_ONLY = range(3)
"""Treatment of a pulse above a cap: reduce its power, stop before it, or count it regardless."""


@kernel
def apply_pulses(
    budget: Budget,
    workspace: LimiterWorkspace,
    pixel: IntArray,
    stage: IntArray,
    start_s: FloatArray,
    width_s: FloatArray,
    x_rad: FloatArray,
    y_rad: FloatArray,
    power_w: FloatArray,
    policy: int,
    granted_w: FloatArray,
    cause: IntArray,
) -> int:
    """Apply n pulses in order of their starts.

    Modifies the workspace, `granted_w` [n] and `cause` [n] (cap numbers). Returns the number of applied pulses. Under
    STOP it can be less than n; granted_w and cause of the following row then hold the power that would have been
    granted and the binding cap.
    """
    for row in range(len(pixel)):
        panel_off_s = start_s[row] - workspace.nodes.panel_at_s[0]
        # With the requested energy: the panel hardly changes by one pulse, and the caps of the others need it before
        # the power is known.
        panel_k = panel_peak_k(budget.heat, workspace.nodes.panel_k, panel_off_s, power_w[row] * width_s[row])
        panel_k += panel_rise_by_others_k(budget.heat, stage[row], width_s[row])
        request = PulseRequest(
            pixel[row], stage[row], start_s[row], width_s[row], x_rad[row], y_rad[row], power_w[row], panel_k
        )
        granted_w[row], cause[row] = request.power_w, NO_CAP
        # Also for a pulse without power: verify() must evaluate the exchange at the same times (see limiter.verify).
        before = compute_start_state(budget, workspace, request)
        min_power_w = budget.min_power_w[stage[row]] * (1.0 - TOLERANCE)
        if request.power_w < min_power_w or request.power_w <= 0.0:
            continue
        if policy != COUNT_ONLY:
            max_w, binding = max_power_w(budget, workspace, request, before)
            if request.power_w > max_w * (1 + TOLERANCE):
                granted_w[row], cause[row] = max(0.0, max_w), binding
                # A negative power is a refusal (order, width) and holds under TRIM, too.
                if policy == STOP or max_w < 0.0:
                    return row
                if granted_w[row] < min_power_w:
                    # Weaker than the laser emits, or the board can let it: dark, and the reason says so.
                    granted_w[row] = 0.0
        if granted_w[row] > 0.0:
            commit(budget, workspace, request, granted_w[row], before)
    return len(pixel)


@kernel
def compute_start_state(budget: Budget, workspace: LimiterWorkspace, request: PulseRequest) -> PixelStartState:
    """Advance a pixel to the start of a pulse and return its state there."""
    exchange_wall_heat(budget.heat, workspace.nodes, request.start_s, budget.caps.pulse_width_s)
    advance_pixel(budget.heat, workspace.nodes, request.pixel, request.start_s)
    budgets, pixel = workspace.budgets, request.pixel
    off_s = max(0.0, request.start_s - workspace.nodes.last_pulse_end_s[pixel])
    rise_k = absorber_after_k(budget.heat, pixel, workspace.nodes.absorber_k[pixel], 0.0, off_s)
    lower_bound_k = lower_bound_after_k(budget.heat, pixel, workspace.nodes.lower_bound_k[pixel], 0.0, off_s)
    bucket_j = max(0.0, budgets.bucket_j[pixel] - off_s * budget.caps.pixel_mean_w)
    has_rested = off_s >= budget.caps.pulse_gap_s - TOLERANCE
    return PixelStartState(rise_k, lower_bound_k, bucket_j, 0.0 if has_rested else budgets.merged_width_s[pixel])


@kernel
def commit(
    budget: Budget, workspace: LimiterWorkspace, request: PulseRequest, power_w: float, before: PixelStartState
) -> None:
    """Add a pulse to all budgets."""
    heat, nodes, budgets, pixel = budget.heat, workspace.nodes, workspace.budgets, request.pixel
    rise_k, lower_bound_k, bucket_j, merged_width_s = before
    end_s = request.start_s + request.width_s
    # Peaks and drives are read before the nodes advance: they need wall and lower bound at the pulse's start.
    budgets.peak_k[pixel] = max(budgets.peak_k[pixel], absorber_peak_k(budget, workspace, request, rise_k, power_w))
    nodes.absorber_k[pixel] = absorber_after_k(heat, pixel, rise_k, power_w, request.width_s)
    drive_k = heat.touch_per_wall_k * wall_credited_peak_k(budget, workspace.nodes, request, lower_bound_k, power_w)
    nodes.lower_bound_k[pixel] = lower_bound_after_k(heat, pixel, lower_bound_k, power_w, request.width_s)
    if is_move(budgets, request):
        store_move(budgets, request, galvo_after_move(budget, budgets, request))
    nodes.last_pulse_end_s[pixel] = budgets.end_s[request.stage] = end_s
    budgets.begun_s[0] = max(request.start_s, budgets.begun_s[0])

    for lag in range(2):
        touch_k = touch_after_k(heat, nodes, pixel, lag, drive_k, request.width_s)
        nodes.touch_k[pixel, lag] = touch_k + heat.touch_k_per_j[lag] * power_w * request.width_s
    for capacity in range(2):
        wall_k = wall_after_k(heat, nodes, pixel, capacity, request.width_s)
        nodes.wall_k[pixel, capacity] = wall_k + heat.wall_k_per_j[capacity] * power_w * request.width_s
    # Wall and touch surface stand at the pulse's end now; a pulse of another stage that overlaps uses `_wall_since_k`.
    nodes.nodes_at_s[pixel] = end_s
    warm_panel(heat, nodes, request.start_s, request.width_s, power_w * request.width_s)

    # It leaks during the pulse as well, as the board's does from the begin of one pulse to that of the next.
    budgets.bucket_j[pixel] = max(0.0, bucket_j + (power_w - budget.caps.pixel_mean_w) * request.width_s)
    budgets.merged_width_s[pixel] = merged_width_s + request.width_s
    history = workspace.history
    row = history.n_valid[0]
    history.start_s[row], history.width_s[row] = request.start_s, request.width_s
    history.power_w[row], history.pixel[row], history.stage[row] = power_w, pixel, request.stage
    history.n_valid[0] = row + 1
    append(workspace.pixel_chains, pixel, history, row)
    append(workspace.stage_chains, request.stage, history, row)


REQUEST = PulseRequest(0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
BEFORE = PixelStartState(0.0, 0.0, 0.0, 0.0)


class ColdStart:
    """The second process of one that plans for the first time."""

    def __init__(self) -> None:
        self._is_first = True
        self._process: subprocess.Popen[bytes] | None = None

    def begin(self, budget: Budget, state: BudgetState) -> None:
        """Start the second process unless the limiter is compiled already."""
        if not self._is_first:
            return
        self._is_first = False
        # Without a cache on the disk the halves could not meet.
        if CACHED and not is_cached(apply_pulses):
            command = [sys.executable, "-P", "-m", __name__]
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL)
            assert self._process.stdin is not None  # noqa: S101
            with suppress(BrokenPipeError), self._process.stdin as pipe:
                pipe.write(pickle.dumps(_list_types(budget, open_workspace(state, 1), REQUEST, BEFORE)))

    def finish(self, budget: Budget, state: BudgetState) -> None:
        """Compile this process's half and wait for the other."""
        process, self._process = self._process, None
        if process is not None:
            workspace = open_workspace(state, 1)
            _compile(compute_start_state, _list_types(budget, workspace, REQUEST))
            _compile(commit, _list_types(budget, workspace, REQUEST, 0.0, BEFORE))
            process.wait()


COLD_START = ColdStart()
"""That of this process."""


_find_type: Callable[[object], Any] = numba.typeof  # numba has no types


def _list_types(*arguments: object) -> tuple[Any, ...]:
    """Return numba's types of a kernel's arguments. They alone tell read-only arrays from others after pickling."""
    return tuple(map(_find_type, arguments))


def _compile(kernel: Any, types: tuple[Any, ...]) -> None:
    kernel.compile(types)


def main() -> None:
    """Compile the second half for the pickled types on standard input, which the process that plans has sent."""
    die_with_parent()
    _compile(max_power_w, pickle.load(sys.stdin.buffer))  # noqa: S301


if __name__ == "__main__":
    main()
