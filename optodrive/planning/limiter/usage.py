"""How near each cap is at a moment, by the limiter's own bound."""

from math import exp
from typing import NamedTuple

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.plans import BudgetState
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.heat_bound import absorber_after_k, advance_pixel, exchange_wall_heat, wall_bound_k
from optodrive.planning.limiter.pulse_application import LimiterWorkspace
from optodrive.planning.limiter.workspace import open_workspace

ABSORBER, WALL, TOUCH, SPOT = range(4)


class Usage(NamedTuple):
    """What of one cap is used, in the cap's own unit (rises in K); pixel: where the most is, None for no one place."""

    cap: str
    used: float
    limit: float
    pixel: int | None


def compute_usage(state: BudgetState, budget: Budget, at_s: float) -> tuple[Usage, ...]:
    """Every cap that is used little by little, at at_s on the state's time line, dark since the state's own time."""
    caps, pixels = budget.caps, len(state.rise_k)
    peak = np.zeros((4, pixels))
    at_s = max(at_s, state.at_s)
    _fill_levels(budget, open_workspace(state, 0), at_s, peak)
    peak_pixel = peak.argmax(axis=1)
    pixel_w = (
        np.bincount(state.recent_pixel, _compute_window_energy_j(state, at_s, caps.pixel_window_s), pixels)
        / caps.pixel_window_s
    )
    display_w = float(_compute_window_energy_j(state, at_s, caps.display_window_s).sum()) / caps.display_window_s
    decay = exp(-max(0.0, at_s - state.mirror_at_s) / budget.galvo.averaging_s)
    return (
        Usage("absorber_temperature", float(peak[ABSORBER].max()), caps.absorber_k, int(peak_pixel[ABSORBER])),
        Usage("wall_temperature", float(peak[WALL].max()), caps.wall_k, int(peak_pixel[WALL])),
        Usage("touch_temperature", float(peak[TOUCH].max()), caps.touch_k, int(peak_pixel[TOUCH])),
        Usage("spot_energy", float(peak[SPOT].max()), caps.pulse_energy_j, int(peak_pixel[SPOT])),
        Usage("pixel_mean_power", float(pixel_w.max()), caps.pixel_mean_w, int(pixel_w.argmax())),
        Usage("display_mean_power", display_w, caps.display_mean_w, None),
        Usage("galvo_acceleration", float(state.galvo_mean_square.max()) * decay, caps.galvo_rad2_per_s4, None),
    )


def _compute_window_energy_j(state: BudgetState, at_s: float, window_s: float) -> FloatArray:
    """What each recent pulse [r] gave within the window that ends at at_s."""
    begin_s = np.maximum(state.recent_start_s, at_s - window_s)
    end_s = np.minimum(state.recent_start_s + state.recent_width_s, at_s)
    return np.asarray(np.clip(end_s - begin_s, 0.0, None) * state.recent_power_w, dtype=np.float64)


@kernel
def _fill_levels(budget: Budget, workspace: LimiterWorkspace, at_s: float, levels: FloatArray) -> None:
    """Fill in bounds [4, p] at at_s, without light until then; the ledger moves there."""
    heat, nodes = budget.heat, workspace.nodes
    exchange_wall_heat(heat, nodes, at_s, 0.0)
    for pixel in range(levels.shape[1]):
        advance_pixel(heat, nodes, pixel, at_s)
        off_s = max(0.0, at_s - nodes.last_pulse_end_s[pixel])
        wall_k = wall_bound_k(heat, nodes, pixel)
        rise_k = absorber_after_k(heat, pixel, nodes.absorber_k[pixel], 0.0, off_s)
        levels[ABSORBER, pixel] = rise_k + heat.absorber_wall_factor * wall_k
        levels[WALL, pixel] = wall_k
        levels[TOUCH, pixel] = heat.touch_specht_ratio * max(nodes.touch_k[pixel, 0], nodes.touch_k[pixel, 1])
        levels[SPOT, pixel] = max(0.0, workspace.budgets.bucket_j[pixel] - off_s * budget.caps.pixel_mean_w)
