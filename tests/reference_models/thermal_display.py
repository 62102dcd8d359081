"""A numerical integrator of a display's heat and servos, and hostile sequences.

It shares no code with the limiter and the physics package.
"""

from dataclasses import dataclass
from math import inf

import numpy as np

from optodrive.core.kernels import array_kernel
from optodrive.core.types.plans import EMPTY_PLAN, PulsePlan
from optodrive.device.config_sections import DisplaySection
from optodrive.device.panel import Neighbours
from optodrive.planning.limiter.budget import select_galvo
from optodrive.planning.limiter.caps import CapValues
from optodrive.planning.limiter.panel_bound import (
    NominalPanel,
    NominalThermalModel,
    NominalTouch,
    NominalWalls,
    Uncertainty,
)

NO_CAPS = CapValues(
    **dict.fromkeys(CapValues._fields, inf)
    | {"absorber_k": 1e3, "wall_k": 500.0, "touch_k": 500.0, "pulse_energy_j": 1e3, "pulse_width_s": 0.050}
    | {"pulse_gap_s": 5e-4, "pixel_mean_w": 1e3, "pixel_window_s": 1.0, "display_mean_w": 1e3, "display_window_s": 2.0}
)
"""Caps that do not bind."""


def build_lasers(pwm_period_s, count=1):
    """Return the last fields of a `Budget`: of lasers in proportion, without a weakest pulse."""
    return np.full(count, pwm_period_s), np.zeros(count), np.full(count, True)


SETTLED_AFTER_S = 1.8
"""Time after a pulse, s, after which absorbers and gas have settled to their walls: over twenty time constants."""


@array_kernel
def _fill_leaving_w(y, leaving_w, numbers, neighbours, frame_edges):
    """Fill in the heat flow from each wall [p], W, to the panel and to its neighbours. Return that to the panel."""
    rw, rx, rf, into_panel_w = numbers[6], numbers[8], numbers[9], 0.0
    if numbers[7] == 0.0:  # no walls
        return 0.0
    for i in range(y.shape[1]):
        leaving_w[i] = (y[2, i] - y[4, 0]) * (1 / rw + frame_edges[i] / rf)
        into_panel_w += leaving_w[i]
        for k in range(4):
            if neighbours[i, k] >= 0:
                leaving_w[i] += (y[2, i] - y[2, neighbours[i, k]]) / rx
    return into_panel_w


@array_kernel
def _rates(y, out, power_w, is_settled, numbers, neighbours, frame_edges):
    """Compute dy/dt of y [5, p], light power_w [p]: absorber, gas, wall and touch surface, and the panel in y[4, 0].

    Absorber and gas of a pixel that is_settled [p] are as warm as its wall. Without walls the absorbers lose their heat
    to the panel, and y[2] is the panel.
    """
    eps, r, c, ambient_k, n, tau_g, _, cw, _, _, fg, fw, lag, rp, cp = numbers
    into_panel, panel = _fill_leaving_w(y, out[2], numbers, neighbours, frame_edges), y[4, 0]
    for i in range(y.shape[1]):
        theta, gas, wall, touch = y[0, i], y[1, i], y[2, i], y[3, i]
        out[3, i] = (panel + fg * (gas - panel) + fw * (wall - panel) - touch) / lag if lag > 0.0 else 0.0
        if is_settled[i]:
            out[0, i] = out[1, i] = out[2, i] = -out[2, i] / (cw + c)
            continue
        mean = ambient_k + 0.5 * (theta + wall)
        flow = (theta - wall) / (r * (mean / ambient_k) ** n) if n != 0.0 else (theta - wall) / r
        out[0, i] = (eps * power_w[i] - flow) / c
        out[1, i] = (0.5 * (theta + wall) - gas) / tau_g
        if cw > 0.0:
            out[2, i] = (flow - out[2, i]) / cw
        else:
            into_panel += flow
    out[4] = 0.0
    if cp > 0.0:
        out[4, 0] = (into_panel - panel / rp) / cp
    if cw == 0.0:
        out[2] = out[4, 0]


@array_kernel
def _slow_rates(y, out, numbers, neighbours, frame_edges):
    """Compute dy/dt of walls, touch surfaces and panel when absorbers and gas have settled to their walls."""
    _, _, c, _, _, _, _, cw, _, _, fg, fw, lag, rp, cp = numbers
    out[:] = 0.0
    into_panel, panel = _fill_leaving_w(y, out[2], numbers, neighbours, frame_edges), y[4, 0]
    for i in range(y.shape[1]):
        out[2, i] = -out[2, i] / (cw + c) if cw > 0.0 else 0.0
        out[3, i] = (panel + (fg + fw) * (y[2, i] - panel) - y[3, i]) / lag if lag > 0.0 else 0.0
    if cp > 0.0:
        out[4, 0] = (into_panel - panel / rp) / cp
    if cw == 0.0:
        out[2] = out[4, 0]


@array_kernel
def _advance(y, h, rate, out):
    """Compute y + h · rate and return it: in loops, which take a tenth of the time to compile that array sums do."""
    for kind in range(y.shape[0]):
        for i in range(y.shape[1]):
            out[kind, i] = y[kind, i] + h * rate[kind, i]
    return out


@array_kernel
def _rest(y, peak, time_s, numbers, neighbours, frame_edges):
    """Integrate a rest with settled absorbers and gas by Heun's method."""
    k1, k2, ahead = np.empty_like(y), np.empty_like(y), np.empty_like(y)
    _, _, _, _, _, _, rw, cw, rx, rf, _, _, lag, _, _ = numbers
    longest = 1.0
    if cw > 0.0:
        longest = min(longest, 0.1 * cw / (1 / rw + 4 / rx + 4 / rf))
    if lag > 0.0:
        longest = min(longest, 0.1 * lag)
    steps = int(np.ceil(time_s / longest))
    h = time_s / steps
    for _ in range(steps):
        _slow_rates(y, k1, numbers, neighbours, frame_edges)
        _slow_rates(_advance(y, h, k1, ahead), k2, numbers, neighbours, frame_edges)
        for kind in range(2, 5):
            for i in range(y.shape[1]):
                y[kind, i] += 0.5 * h * (k1[kind, i] + k2[kind, i])
                peak[kind] = max(peak[kind], y[kind, i])
    y[0] = y[1] = y[2]


@array_kernel
def _integrate(y, peak, at, pixel, watts, until, numbers, neighbours, frame_edges, on_step, off_step):
    """Integrate by the fourth-order Runge–Kutta method between edges.

    peak: [5] receives the maximum of each kind
    at, pixel, watts: [e] light on a pixel from an edge on
    """
    k1, k2, k3, k4 = np.empty_like(y), np.empty_like(y), np.empty_like(y), np.empty_like(y)
    ahead = np.empty_like(y)
    power, now = np.zeros(y.shape[1]), 0.0
    has_walls, is_settled, edge_at = numbers[7] > 0.0, np.zeros(y.shape[1], dtype=np.bool_), np.zeros(y.shape[1])
    for edge in range(len(at) + 1):
        end = at[edge] if edge < len(at) else until
        if end > now:
            is_on, slow_s = power.any(), 0.0
            if not is_on and end - now > SETTLED_AFTER_S:
                slow_s = end - now - SETTLED_AFTER_S
                end = now + SETTLED_AFTER_S
            steps = int(np.ceil((end - now) / (on_step if is_on else off_step)))
            h = (end - now) / steps
            for _ in range(steps):
                _rates(y, k1, power, is_settled, numbers, neighbours, frame_edges)
                _rates(_advance(y, 0.5 * h, k1, ahead), k2, power, is_settled, numbers, neighbours, frame_edges)
                _rates(_advance(y, 0.5 * h, k2, ahead), k3, power, is_settled, numbers, neighbours, frame_edges)
                _rates(_advance(y, h, k3, ahead), k4, power, is_settled, numbers, neighbours, frame_edges)
                for kind in range(5):
                    for i in range(y.shape[1] if kind < 4 else 1):
                        y[kind, i] += h / 6 * (k1[kind, i] + 2 * k2[kind, i] + 2 * k3[kind, i] + k4[kind, i])
                        peak[kind] = max(peak[kind], y[kind, i])
            now = end
            if slow_s > 0.0:
                _rest(y, peak, slow_s, numbers, neighbours, frame_edges)
                now += slow_s
        if edge < len(at):
            power[pixel[edge]], is_settled[pixel[edge]], edge_at[pixel[edge]] = watts[edge], False, now
        for i in range(y.shape[1] if has_walls else 0):
            if not is_settled[i] and power[i] == 0.0 and now - edge_at[i] > SETTLED_AFTER_S:
                is_settled[i], y[0, i], y[1, i] = True, y[2, i], y[2, i]


TOUCHED = (2, 3, 4)
"""Places that a finger can touch, by their rows in the peaks: walls, touch surfaces and panel."""


@dataclass(frozen=True)
class TrueDisplay:
    """The true parameters of one display: `numbers` for the integrator, and the lattice."""

    numbers: tuple
    neighbours: np.ndarray
    frame_edges: np.ndarray

    def peaks(self, plan, dark_s=3.0):
        """Return the largest rise of absorber, gas, wall, touch surface and panel, K, until `dark_s` after the plan."""
        lag_s = self.numbers[5]  # the fastest node; steps above 2.8 of its time constants would be unstable
        y, peak = np.zeros((5, len(self.frame_edges))), np.zeros(5)
        ends = plan.start_s + plan.width_s
        # At one time a pulse ends before the next one on its pixel begins.
        order = np.lexsort((np.repeat([1, 0], len(ends)), np.concatenate([plan.start_s, ends])))
        _integrate(
            y,
            peak,
            np.concatenate([plan.start_s, ends])[order],
            np.tile(plan.pixel, 2)[order],
            np.concatenate([plan.power_w, np.zeros(len(ends))])[order],
            float(ends.max()) + dark_s,
            self.numbers,
            self.neighbours,
            self.frame_edges,
            min(1e-3, 0.5 * lag_s),
            lag_s,
        )
        return peak


def build_true_display(model, factor=None):
    """Build the true display from a nominal model, with each parameter times its factor (the exponent: plus)."""
    f = dict.fromkeys(Uncertainty.__dataclass_fields__, 1.0) | {"exponent": 0.0} | (factor or {})
    walls, touch, panel = model.walls, model.touch, model.panel
    numbers = (
        float(model.epsilon[0]) * f["absorbed_power"],
        float(model.r_k_per_w[0]) * f["bridge_resistance"],
        float(model.c_j_per_k[0]) * f["absorber_capacity"],
        model.ambient_k,
        model.exponent + f["exponent"],
        model.tau_g_s * f["gas_lag"],
        walls.r_k_per_w * f["wall_resistance"] if walls else 1.0,
        walls.c_j_per_k * f["wall_capacity"] if walls else 0.0,
        walls.lateral_k_per_w * f["side_resistance"] if walls else 1.0,
        walls.frame_k_per_w * f["side_resistance"] if walls else 1.0,
        touch.gas_share * f["touch_share"] if touch else 0.0,
        touch.wall_share * f["touch_share"] if touch else 0.0,
        touch.lag_s * f["touch_lag"] if touch else 0.0,
        panel.r_k_per_w * f["panel_resistance"] if panel else 1.0,
        panel.c_j_per_k * f["panel_capacity"] if panel else 0.0,
    )
    return TrueDisplay(numbers, np.array(model.neighbours), np.array(model.frame_edges))


@array_kernel
def _coil(at_s, command_rad, until_s, omega, damping, delay_s, slew, mean_s):
    """Return the peak exponential mean of one servo's squared acceleration, rad²/s⁴, by fourth-order Runge–Kutta."""
    angle, speed, target, mean, maximum, now = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    still_s, longest = 14.0 / (damping * omega), 0.02 / omega
    for row in range(len(at_s)):
        command, end = command_rad[row], at_s[row + 1] + delay_s if row + 1 < len(at_s) else until_s
        begin = at_s[row] + delay_s
        mean, now = mean * np.exp(-max(0.0, begin - now) / mean_s), max(now, begin)
        ramp_s = min(abs(command - target) / slew, max(0.0, end - now))
        for phase in range(2):
            stop = min(end, now + (ramp_s if phase == 0 else still_s))
            rate = slew * np.sign(command - target) if phase == 0 else 0.0
            if stop <= now:
                continue
            steps = int(np.ceil((stop - now) / longest))
            h = (stop - now) / steps
            for _ in range(steps):
                a1 = omega**2 * (target - angle) - 2 * damping * omega * speed
                s2, half = speed + 0.5 * h * a1, target + 0.5 * h * rate
                a2 = omega**2 * (half - angle - 0.5 * h * speed) - 2 * damping * omega * s2
                s3 = speed + 0.5 * h * a2
                a3 = omega**2 * (half - angle - 0.5 * h * s2) - 2 * damping * omega * s3
                s4 = speed + h * a3
                a4 = omega**2 * (target + h * rate - angle - h * s3) - 2 * damping * omega * s4
                angle += h / 6 * (speed + 2 * s2 + 2 * s3 + s4)
                speed += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
                target += h * rate
                after = omega**2 * (target - angle) - 2 * damping * omega * speed
                mean += (0.5 * (a1**2 + after**2) - mean) * -np.expm1(-h / mean_s)
                maximum = max(maximum, mean)
            now = stop
            if phase == 0 and ramp_s * slew >= abs(command - target) - 1e-12:
                target = command
        if now < end:  # it has stood still for long
            angle, speed = target, 0.0
    return maximum


def galvo_peak(plan, budget, stage=0):
    """Return the peak mean-square acceleration of both mirrors' servos of a stage, rad²/s⁴.

    Two cases are simulated: the mirrors leave at the end of the last pulse with power, or one lead-in before a pulse.
    """
    galvo = select_galvo(budget.galvos, stage)
    driven = np.flatnonzero((plan.power_w > 0) & (plan.stage == stage))
    if not len(driven):
        return 0.0
    ends_s = np.append(0.0, (plan.start_s + plan.width_s)[driven])
    numbers = (galvo.omega_rad_per_s, galvo.damping, galvo.delay_s, galvo.slew_rad_per_s, galvo.averaging_s)
    late_s = np.maximum(ends_s[:-1], plan.start_s[driven] - galvo.lead_in_s)
    return max(
        _coil(at_s, angle_rad[driven].copy(), ends_s[-1] + 0.1, *numbers)
        for at_s in (ends_s[:-1].copy(), late_s)
        for angle_rad in (plan.x_rad, plan.y_rad)
    )


def window_peak_w(plan, window_s):
    """Return the largest mean power over any window, from the delivered energy at all pulse edges."""
    if not len(plan):
        return 0.0
    edges_s = np.stack([plan.start_s, plan.start_s + plan.width_s], axis=1).ravel()
    energy_j = np.repeat(np.cumsum(plan.power_w * plan.width_s), 2)
    energy_j[::2] -= plan.power_w * plan.width_s
    ends_s = np.concatenate([edges_s, edges_s + window_s])
    inside_j = np.interp(ends_s, edges_s, energy_j) - np.interp(ends_s - window_s, edges_s, energy_j, left=0.0)
    return inside_j.max() / window_s


def small_lattice(rng):
    """Draw a lattice of a few rows and columns, sometimes with a missing pixel."""
    rows, columns = int(rng.integers(1, 5)), int(rng.integers(2, 5))
    missing = ((0, 0),) if rng.random() < 0.3 else ()
    return DisplaySection(rows=rows, columns=columns, pitch_m=4e-3, missing=missing, bridge_width_m=4e-4)


def random_model(rng):
    """Draw a display, a nominal model, in which terms are sometimes absent, and its uncertainty."""
    display = small_lattice(rng)
    neighbours = Neighbours.from_display(display)
    pixels = len(neighbours)
    walls = touch = None
    if rng.random() < 0.85:
        r_w = rng.uniform(3.0, 40.0)
        sides = rng.random() < 0.8
        walls = NominalWalls(
            r_w,
            rng.uniform(0.4, 4.0) / r_w,
            10 ** rng.uniform(2.0, 3.0) if sides else np.inf,
            10 ** rng.uniform(2.0, 3.0) if sides else np.inf,
        )
    if rng.random() < 0.85:
        touch = NominalTouch(rng.uniform(0.05, 0.5), rng.uniform(0.1, 0.5), rng.uniform(0.5, 3.0))
    panel = None
    if rng.random() < 0.7:
        slowest_s = max(walls.r_k_per_w * walls.c_j_per_k if walls else 0.5, touch.lag_s if touch else 0.0)
        r_p = 10 ** rng.uniform(0.0, 2.0)
        panel = NominalPanel(r_p, slowest_s * 10 ** rng.uniform(1.0, 2.5) / r_p)
    r = rng.uniform(95, 382)
    model = NominalThermalModel(
        epsilon=np.full(pixels, 0.66),
        r_k_per_w=np.full(pixels, r),
        c_j_per_k=np.full(pixels, rng.uniform(80e-6, 130e-6)),
        tau_g_s=rng.uniform(1e-3, 5e-3),
        ambient_k=293.15,
        exponent=float(rng.choice([0.0, 0.05, 0.3, 1.0])),
        neighbours=neighbours.indices,
        frame_edges=neighbours.frame_edges,
        walls=walls,
        touch=touch,
        panel=panel,
    )
    unsure = Uncertainty(
        absorbed_power=rng.uniform(0, 0.1),
        bridge_resistance=rng.uniform(0, 0.1),
        absorber_capacity=rng.uniform(0, 0.15),
        exponent=rng.uniform(0, 0.05),
        gas_lag=rng.uniform(0, 0.3),
        wall_resistance=rng.uniform(0, 0.2),
        wall_capacity=rng.uniform(0, 0.3),
        side_resistance=rng.uniform(0, 0.3),
        touch_share=rng.uniform(0, 0.1),
        touch_lag=rng.uniform(0, 0.3),
        panel_resistance=rng.uniform(0, 0.3),
        panel_capacity=rng.uniform(0, 0.3),
    )
    return display, model, unsure


def sample_factors(rng, unsure):
    """Draw a factor for each parameter within its half-width: anywhere, or at an end."""
    ends = rng.random() < 0.5
    factor = {}
    for name in Uncertainty.__dataclass_fields__:
        half = getattr(unsure, name)
        place = rng.choice([-1.0, 1.0]) if ends else rng.uniform(-1.0, 1.0)
        factor[name] = half * place + (0.0 if name == "exponent" else 1.0)
    return factor


def upper_factors(unsure):
    """Return the parameter factors with the highest steady temperatures."""
    high = ("absorbed_power", "bridge_resistance", "wall_resistance", "side_resistance", "panel_resistance")
    high = (*high, "touch_share", "exponent")
    return {name: getattr(unsure, name) + (0.0 if name == "exponent" else 1.0) for name in high}


KINDS = ("hammer", "ring", "whole", "bursts", "scatter")


def build_sequence(rng, kind, pixels, span_s=3.0):
    """Draw pixels, starts and widths of a hostile sequence on one beam, in whole microseconds, with time for moves."""
    home = int(rng.integers(pixels))
    ring = rng.permutation(pixels)[: int(rng.integers(2, 9))]
    duty, max_width = rng.uniform(0.3, 1.0), rng.choice([2e-3, 15e-3, 50e-3])
    now, rows, order = 0.001, [], 0
    while now < span_s and len(rows) < 400:
        pixel = {"hammer": home, "ring": int(ring[order % len(ring)]), "whole": order % pixels}.get(
            kind, int(rng.integers(pixels))
        )
        if kind == "bursts":
            pixel = home if rng.random() < 0.8 else pixel
            if rng.random() < 0.06:
                now += rng.choice([0.2, 1.0, 5.0])
        width = round(rng.uniform(0.2, 1.0) * max_width * 5000) / 5000 or 2e-4
        rows.append((pixel, now, width))
        rest = 5.2e-4 if rng.random() < 0.5 else max(5.2e-4, width * (1 / duty - 1))
        now = round((now + width + rest) * 1e6) * 1e-6
        order += 1
    return rows


def build_long_sequence(rng, pixels, panel_s):
    """Draw rows as `build_sequence`: drives and rests of up to a few time constants of the panel, some for hours."""
    now, rows, span_s = 0.001, [], panel_s * 10 ** rng.uniform(0.5, 1.5)
    while now < span_s and len(rows) < 4000:
        ring = rng.permutation(pixels)[: int(rng.integers(1, pixels + 1))]
        width = float(rng.choice([5e-3, 20e-3, 50e-3]))
        rest = float(rng.choice([5.2e-4, 5e-3, width]))
        count = int(panel_s * 10 ** rng.uniform(-2.0, 0.5) / (width + rest)) + 1
        for order in range(min(count, 4000 - len(rows))):
            rows.append((int(ring[order % len(ring)]), round(now * 1e6) * 1e-6, width))
            now += width + rest
        now += panel_s * 10 ** rng.uniform(-3.0, 0.5)
    return rows


def build_stages(rng, stages, pixels, build_rows):
    """Draw rows as `build_sequence` on the beam of every stage, each on pixels of its own, and the stage of each row.

    build_rows: draws the rows of one beam for a number of pixels
    """
    groups = [group for group in np.array_split(rng.permutation(pixels), stages) if len(group)]
    rows = [
        (start, int(group[pixel]), width, stage)
        for stage, group in enumerate(groups)
        for pixel, start, width in build_rows(len(group))
    ]
    return [(pixel, start, width) for start, pixel, width, _ in sorted(rows)], [row[3] for row in sorted(rows)]


def build_plan(rows, power_w, display, stage=0):
    """Build a plan from rows of (pixel, start_s, width_s) at one power, or at powers [n]."""
    pixel, start, width = (np.array(column) for column in zip(*rows, strict=True))
    n = len(rows)
    side = int(np.ceil(np.sqrt(pixel.max() + 1)))
    return PulsePlan(
        **{
            **{name: np.zeros(n, dtype=column.dtype) for name, column in vars(EMPTY_PLAN).items()},
            "pixel": pixel.astype(np.int64),
            "start_s": start.astype(float),
            "width_s": width.astype(float),
            "x_rad": (pixel % side - side / 2) * display.pitch_m / 0.44,
            "y_rad": (pixel // side - side / 2) * display.pitch_m / 0.44,
            "power_w": np.broadcast_to(np.asarray(power_w, dtype=float), n).copy(),
            "stage": np.broadcast_to(np.asarray(stage, dtype=np.int64), n).copy(),
        }
    )
