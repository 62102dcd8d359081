"""No accepted model file lets absorber, wall or touch surface pass a cap: random and adversarial discovered terms.

Each set is a file, read and planned by the functions that `plan` and `serve` call. The judge integrates the tables of
the file, and shares no code with physics, planning or the limiter. No uncertainty is declared: it must hide nothing.
Caps are judged without the refusal of plans that leave the range of a table, which has a test of its own.
"""

import re
from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.core.kernels import array_kernel
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.device.config_file import load_config
from optodrive.device.config_sections import PanelSection
from optodrive.physics import discovered_term, extended_display
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.check import check_feasibility

CONFIG = load_config("display-1")
AMBIENT_C, FULL_W = CONFIG.ambient_c, CONFIG.laser.max_power_w
KNOTS, SLOTS, LINE_MAX = 65, 4, 1000
TOLERANCE = 1e-6
"""Of a cap: the judge's own error, and what counts as 0."""
PLACES = {
    "light": ("1", ("absorber", "power", "since_opening")),
    "heat_capacity": ("1", ("absorber",)),
    "absorber": ("W", ("absorber", "gas", "memory")),
    "gas": ("K/s", ("absorber", "gas", "memory", "drive")),
    "displacement": ("m", ("absorber", "gas", "drive")),
}
SIZES = {"light": 10.0, "heat_capacity": 10.0, "absorber": 10.0, "gas": 1e6, "displacement": 0.01}
ENDS = {"power": 100.0, "since_opening": 1000.0}


def draw_size(rng, largest):
    """Return a size between 1e-9 of the largest plausible one and ten times it, often exactly it."""
    return float(rng.choice([largest, largest * 10 ** rng.uniform(-9.0, 0.0), largest * 10 ** rng.uniform(0.0, 1.0)]))


def draw_table(rng, where, depends_on, pixel):
    """Return low, high and values of a table that may break any assumption of a bound."""
    usual = {"power": FULL_W, "since_opening": 0.05}.get(depends_on, 150.0)
    high = usual * float(rng.choice([1.0, 10 ** rng.uniform(-2.0, 1.0)], p=[0.6, 0.4]))
    if rng.random() < 0.05:
        high = draw_size(rng, ENDS.get(depends_on, 2000.0))
    low = 0.0
    if depends_on not in ENDS and rng.random() < 0.4:
        low = high * float(rng.choice([-1.0, -0.02, -rng.random(), -(10 ** rng.uniform(-12, 1)), rng.random()]))
    z = np.linspace(low, high, KNOTS)
    sizes = {"light": 1.0, "heat_capacity": 0.8, "absorber": 0.7 * high / pixel["R"], "gas": 1e4, "displacement": 1e-4}
    size = sizes[where] * rng.random() * (FULL_W if depends_on == "power" else 1.0) * rng.choice([-1.0, 1.0])
    shapes = (
        lambda: z / high,
        lambda: (z / high) ** 2,
        lambda: np.tanh(4.0 * z / high),
        lambda: z / high * (rng.random(KNOTS) - rng.random()),
        lambda: np.where(np.arange(KNOTS) >= rng.integers(1, KNOTS), 1.0, 0.0) * np.where(z > 0.0, 1.0, 0.0),
        lambda: np.where(np.arange(KNOTS) == rng.choice([0, KNOTS - 1, rng.integers(KNOTS)]), 1.0, 0.0),
        lambda: np.abs(z / high),
        lambda: np.exp(-(((z / high - rng.random()) / 0.1) ** 2)) * (z != 0.0),
    )
    values = size * shapes[rng.integers(len(shapes))]()
    if where in ("light", "heat_capacity") and depends_on != "power" and rng.random() < 0.3:
        values = values + rng.uniform(-1.0, 0.3)
    if rng.random() < 0.2:  # at, or beyond, the edge of the plausible, beside which something at 0 is small
        values[rng.integers(KNOTS)] = draw_size(rng, SIZES[where]) * rng.choice([-1.0, 1.0])
    if rng.random() < 0.1:
        values[0] += draw_size(rng, SIZES[where])
    return low, high, values


def draw_terms(rng, pixel):
    """Return one to four discovered terms as tables of a file."""
    memory_s = float(rng.choice([10 ** rng.uniform(-2.61, 1.01), rng.uniform(0.003, 0.08)]))
    terms = []
    for _ in range(int(rng.choice([1, 2, 3, 4], p=[0.55, 0.25, 0.1, 0.1]))):
        where = str(rng.choice(list(PLACES), p=[0.25, 0.15, 0.45, 0.1, 0.05]))
        unit, quantities = PLACES[where]
        depends_on = str(rng.choice(quantities))
        low, high, values = draw_table(rng, where, depends_on, pixel)
        term = {"where": where, "depends_on": depends_on, "unit": "W" if depends_on == "power" else unit}
        term |= {"low": low, "high": high, "values": values.tolist()}
        terms.append(term | ({"memory_time_s": memory_s} if depends_on == "memory" else {}))
    return terms


def build_term(where, depends_on, low, high, values, **more):
    unit = "W" if depends_on == "power" else PLACES[where][0]
    ends = {"low": float(low), "high": float(high), "values": [float(value) for value in values]}
    return {"where": where, "depends_on": depends_on, "unit": unit} | ends | more


def attack_with_an_offset(rng, pixel):
    """Return a flow into the cold absorber that is small beside the table's other end."""
    offset_w = 10 ** rng.uniform(-7.0, 0.5)
    last_w = -offset_w * 10 ** rng.choice([rng.uniform(0.0, 6.0), rng.uniform(6.0, 7.0)])
    high_k = 10 ** rng.uniform(0.0, 11.0)
    quantity = str(rng.choice(["absorber", "memory"]))
    more = {"memory_time_s": float(10 ** rng.uniform(-2.5, -1.0))} if quantity == "memory" else {}
    return [build_term("absorber", quantity, 0.0, high_k, [offset_w, *[0.0] * (KNOTS - 2), last_w], **more)]


def attack_with_a_cold_memory(rng, pixel):
    """Return a memory that heats when it is cold, and a flow to the gas or by itself that makes it cold."""
    cold = int(rng.integers(1, 40))  # 0 is at a knot, as a kink must be
    low_k, high_k = -cold * 4.0, (KNOTS - 1 - cold) * 4.0
    z = 4.0 * (np.arange(KNOTS) - cold)
    values = -np.clip(z, -np.inf, 0.0) * 10 ** rng.uniform(0.0, 2.0) / pixel["R"]
    values -= np.clip(z, 0.0, np.inf) * float(rng.choice([0.0, 3.0])) / pixel["R"]
    values = np.clip(values, -10.0, 10.0) * float(rng.choice([1.0, 1e-9]))
    memory = build_term("absorber", "memory", low_k, high_k, values, memory_time_s=float(10 ** rng.uniform(-2.6, -1.5)))
    loss = -np.linspace(0.0, 1.0, KNOTS) * 200.0 / pixel["R"] * 10 ** rng.uniform(-1.0, 1.5)
    return [memory, build_term("absorber", "gas", 0.0, 200.0, np.clip(loss, -10.0, 0.0))]


def attack_with_negative_light(rng, pixel):
    """Return an even number of factors below darkness."""
    largest = float(rng.choice([10.0, 3.0, 100.0]))
    table = partial(build_term, "light", "absorber", 0.0, 100.0)
    return [table(-largest * rng.random(KNOTS)) for _ in range(2 * int(rng.integers(1, 3)))]


def attack_with_a_tail(rng, pixel):
    """Return a table whose only large value lies at its end, within reach or beyond."""
    where = str(rng.choice(["light", "heat_capacity", "absorber", "gas"]))
    size = {"light": 3.0, "heat_capacity": 5.0, "absorber": 0.5 * 200.0 / pixel["R"], "gas": 3e4}[where]
    at = int(rng.choice([0, KNOTS - 1])) if where in ("light", "heat_capacity") else KNOTS - 1
    values = [0.0] * KNOTS
    values[at] = size * float(rng.random())
    low_k, high_k = (20.0, 60.0) if where in ("light", "heat_capacity") else (0.0, float(rng.uniform(20.0, 200.0)))
    return [build_term(where, "absorber", low_k, high_k, values)]


def attack_with_a_slow_memory(rng, pixel):
    """Return a flow that the slowest mode returns late: as much, and as slowly, as may be accepted."""
    share, ratio = rng.uniform(0.0, 0.5), 10 ** rng.uniform(-0.5, 1.0)
    high_k = 400.0
    values = share * np.linspace(0.0, high_k, KNOTS) / pixel["R"] * rng.choice([1.0, 0.0], p=[0.9, 0.1])
    memory_s = float(np.clip(ratio * pixel["R"] * pixel["C"], 2.6e-3, 10.0))
    return [build_term("absorber", "memory", 0.0, high_k, values, memory_time_s=memory_s)]


ATTACKS = (
    attack_with_an_offset,
    attack_with_a_cold_memory,
    attack_with_negative_light,
    attack_with_a_tail,
    attack_with_a_slow_memory,
)


def draw_attack(rng, pixel):
    """Return the terms of an attack, sometimes beside others."""
    attack = ATTACKS[rng.integers(len(ATTACKS))](rng, pixel)
    others = draw_terms(rng, pixel)[: SLOTS - len(attack)] if rng.random() < 0.2 else []
    return [*attack, *(term for term in others if "memory_time_s" not in term)]


def draw_pixel(rng):
    """Return the numbers of pixel, wall and finger, shipped ones, or any within a factor of three."""
    numbers = dict(USUAL)
    if rng.random() < 0.5:
        numbers = {name: value * 3.0 ** rng.uniform(-1.0, 1.0) for name, value in numbers.items()}
        numbers["gas_share"], numbers["wall_share"] = min(0.6, numbers["gas_share"]), min(0.6, numbers["wall_share"])
        numbers["lag"], numbers["Rw"] = max(0.3, numbers["lag"]), min(40.0, numbers["Rw"])
    return numbers


def write_model(path, pixel, terms, has_wall):
    """Write a set of parameters as a diagnosis does."""

    def state(name, value, unit):
        return f'[{name}]\nvalue = {value!r}\nunit = "{unit}"\nsource = "drawn"\n'

    text = 'format = "optodrive-parameters"\nversion = 1\nname = "own"\nbase = "calibrated"\nclaims = "none"\n'
    text += 'planner_terms = ["discovered"]\n'
    text += state("tau_g", pixel["tau_g"], "s")
    text += f"[[bridge]]\nwidth_m = {CONFIG.display.bridge_width_m!r}\n"
    text += state("bridge.R", pixel["R"], "K/W") + state("bridge.C", pixel["C"], "J/K")
    if has_wall:
        text += state("terms.wall_heating.resistance", pixel["Rw"], "K/W")
        text += state("terms.wall_heating.capacity", pixel["Cw"], "J/K")
        text += state("terms.touch_surface.gas_share", pixel["gas_share"], "1")
        text += state("terms.touch_surface.wall_share", pixel["wall_share"], "1")
        text += state("terms.touch_surface.lag", pixel["lag"], "s")
    for term in terms:
        text += '[[discovered]]\nformula = "f"\nsource = "drawn"\n'
        text += "".join(f'{name} = "{term[name]}"\n' for name in ("where", "depends_on", "unit"))
        numbers = ("low", "high", "memory_time_s", "max_power_w")
        text += "".join(f"{name} = {term[name]!r}\n" for name in numbers if name in term)
        text += f"values = {term['values']!r}\n"
    path.write_text(text)


def build_config(path, caps_c):
    certain = CONFIG.limits.uncertainty.model_copy(update=dict.fromkeys(CONFIG.limits.uncertainty.model_dump(), 0.0))
    loose = {"pixel_mean_power_max_w": FULL_W, "uncertainty": certain, "pulse_energy_max_j": 10.0}
    limits = CONFIG.limits.model_copy(update=caps_c | loose)
    panel = PanelSection(resistance_k_per_w=PANEL[0], capacity_j_per_k=PANEL[1])
    model = CONFIG.pixel_model.model_copy(update={"parameters": str(path)})
    return CONFIG.model_copy(update={"limits": limits, "panel": panel, "pixel_model": model})


PANEL = 30.0, 3.0
"""Resistance to the room, K/W, and capacity with the wall, J/K."""


def draw_sequence(rng):
    """Return trains of full power that follow one another, from sparse to continuous."""
    trains, at_s = [], 0.0
    for _ in range(int(rng.integers(1, 4))):
        width_s = 2e-4 * int(rng.choice([250, rng.integers(5, 250)]))
        gap_s = 2e-4 * int(rng.choice([3, rng.integers(3, 400)]))
        duration_s = float(rng.choice([0.2, 0.6, 2.0], p=[0.5, 0.3, 0.2]))
        trains.append(PulseTrain(0, at_s, duration_s, width_s, gap_s, FULL_W * float(rng.choice([1.0, rng.random()]))))
        at_s += duration_s + width_s + gap_s + float(rng.choice([0.0, 0.1, 0.5]))
    return FrameSequence((), tuple(trains))


@array_kernel
def _look_up(z, term):
    """Return the table's value, constant beyond its ends. term: place, quantity, low, high, time, values."""
    place = (z - term[2]) / (term[3] - term[2]) * 64.0
    if place <= 0.0:
        return term[5]
    if place >= 64.0:
        return term[69]
    left = int(place)
    return term[5 + left] + (place - left) * (term[6 + left] - term[5 + left])


@array_kernel
def _choose(quantity, absorber, gas, memory, watts, since_s, drive):
    """Return the quantity with this number."""
    if quantity == 0:
        return absorber
    if quantity == 1:
        return gas
    if quantity == 2:
        return memory
    if quantity == 3:
        return drive
    return watts if quantity == 4 else since_s


@array_kernel
def _rates(y, out, watts, since_s, pixel, terms):
    """Compute dy/dt of absorber, gas, wall, touch surface, panel and the memories of the terms, all above the room."""
    r, c, tau_g, rw, cw, gas_share, wall_share, lag, rp, cp = pixel
    absorber, gas, panel = y[0], y[1], y[4]
    wall = y[2] if cw > 0.0 else panel
    light, flow, gas_rate, capacity = watts, 0.0, 0.0, 1.0
    for k in range(terms.shape[0]):
        where, quantity = int(terms[k, 0]), int(terms[k, 1])
        base = wall if where == 2 else 0.0
        z = _choose(quantity, absorber - base, gas - base, y[5 + k], watts, since_s, 0.5 * absorber - gas)
        out[5 + k] = (absorber - wall - y[5 + k]) / terms[k, 4] if quantity == 2 else 0.0
        if where == 0 and watts <= 0.0:
            continue
        value = _look_up(z, terms[k])
        if where == 0:
            light = light + value if quantity == 4 else light * (1.0 + value)
        elif where == 1:
            capacity += value
        elif where == 2:
            flow += value
        elif where == 3:
            gas_rate += value
    to_wall_w = (absorber - wall) / r
    out[0] = (0.66 * max(0.0, light) - to_wall_w + flow) * capacity / c
    out[1] = (0.5 * (absorber + wall) - gas) / tau_g + gas_rate
    into_panel_w = to_wall_w
    out[2] = out[3] = 0.0
    if cw > 0.0:
        into_panel_w = (wall - panel) / rw
        out[2] = (to_wall_w - into_panel_w) / cw
        out[3] = (panel + gas_share * (gas - panel) + wall_share * (wall - panel) - y[3]) / lag
    out[4] = (into_panel_w - panel / rp) / cp


@array_kernel
def _integrate(edges_s, watts, pixel, terms, step_s):
    """Return the largest rises of absorber, gas, wall, touch surface and panel, by a Runge–Kutta method.

    Behind them: by what share of its range, at most, each term's quantity was outside of it.
    """
    size = 5 + terms.shape[0]
    outside = np.zeros(terms.shape[0])
    y, peak = np.zeros(size), np.zeros(size)
    k1, k2, k3, k4 = np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size)
    for edge in range(len(watts)):
        span_s = edges_s[edge + 1] - edges_s[edge]
        steps = int(np.ceil(span_s / step_s))
        for number in range(steps):
            h, since_s = span_s / steps, span_s / steps * number
            _rates(y, k1, watts[edge], since_s, pixel, terms)
            _rates(y + 0.5 * h * k1, k2, watts[edge], since_s + 0.5 * h, pixel, terms)
            _rates(y + 0.5 * h * k2, k3, watts[edge], since_s + 0.5 * h, pixel, terms)
            _rates(y + h * k3, k4, watts[edge], since_s + h, pixel, terms)
            y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            peak = np.maximum(peak, y)
            for k in range(terms.shape[0]):
                if terms[k, 0] == 0 and watts[edge] <= 0.0:
                    continue
                base = y[2] if pixel[4] > 0.0 else y[4]
                base = base if terms[k, 0] == 2 else 0.0
                now_s, drive = since_s + h, 0.5 * y[0] - y[1]
                z = _choose(int(terms[k, 1]), y[0] - base, y[1] - base, y[5 + k], watts[edge], now_s, drive)
                beyond = max(terms[k, 2] - z, z - terms[k, 3]) / (terms[k, 3] - terms[k, 2])
                outside[k] = max(outside[k], beyond)
    return np.concatenate((peak[:5], outside))


def find_peaks_k(plan, pixel, terms, has_wall, panel=PANEL, after_s=1.0):
    """Return the largest rises of absorber, gas, wall, touch surface and panel under a plan's pulses.

    Behind them: the share of its range by which each term's quantity leaves it.
    """
    edges_s, watts = [0.0], []
    for start_s, width_s, power_w in zip(plan.start_s, plan.width_s, plan.power_w, strict=True):
        edges_s += [start_s, start_s + width_s]
        watts += [0.0, power_w]
    edges_s.append(edges_s[-1] + after_s)
    places, quantities = list(PLACES), ("absorber", "gas", "memory", "drive", "power", "since_opening")
    rows = [
        [
            float(places.index(term["where"])),
            float(quantities.index(term["depends_on"])),
            *(term["low"], term["high"], term.get("memory_time_s", 1.0), *term["values"]),
        ]
        for term in terms
    ]
    wall_j_per_k = max(pixel["Cw"], 0.1 / pixel["Rw"]) if has_wall else 0.0
    numbers = [pixel[name] for name in ("R", "C", "tau_g", "Rw")]
    numbers += [wall_j_per_k, *(pixel[name] for name in ("gas_share", "wall_share", "lag"))]
    numbers += [panel[0], panel[1] - wall_j_per_k]
    rows = np.array(rows).reshape(len(terms), 5 + KNOTS)
    fastest_s = min(pixel["tau_g"], pixel["R"] * pixel["C"] / 11.0)
    step_s = min(2e-4, 0.2 * fastest_s)
    return _integrate(np.array(edges_s), np.array([*watts, 0.0]), np.array(numbers), rows, step_s)


def judge(rng, folder):
    """Return why drawn terms are refused, and the largest rise over its cap of what a planned sequence heats."""
    pixel, draw = draw_pixel(rng), draw_attack if rng.random() < 0.3 else draw_terms
    terms, has_wall, is_planned = draw(rng, pixel), bool(rng.random() < 0.6), bool(rng.random() < 0.2)
    caps_c = {"absorber_max_c": float(rng.choice([400.0, rng.uniform(60.0, 400.0)]))}
    caps_c |= {"wall_max_c": 80.0, "touch_max_c": float(rng.choice([43.0, 80.0, rng.uniform(28.0, 43.0)]))}
    sequence = draw_sequence(rng)
    return judge_set(folder / "model.toml", pixel, terms, has_wall, is_planned, caps_c, sequence)


def load_display(path, caps_c, is_planned=True):
    """Return the display of a file. Nominal pixels, unless planned, are faster, and the limiter does not know them."""
    display = DisplayModel.from_config(build_config(path, caps_c))
    keys = display.parameters.planner_terms if is_planned else ()
    return replace(display, parameters=display.parameters.model_copy(update={"planner_terms": keys}))


def judge_set(path, pixel, terms, has_wall, is_planned, caps_c, sequence):
    write_model(path, pixel, terms, has_wall)
    try:
        display = load_display(path, caps_c, is_planned)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(extended_display, "check_reached", lambda *_: None)
            planned, _ = check_feasibility(display, sequence, *display.build_cold_state())
    except InputError as error:
        message = str(error)
        assert message.isprintable()
        assert len(message) <= LINE_MAX
        return message, 0.0
    peaks_k = find_peaks_k(planned.plan, pixel, terms, has_wall)
    touched_k = caps_c["touch_max_c"] - AMBIENT_C
    caps_k = {0: caps_c["absorber_max_c"] - AMBIENT_C, 2: min(touched_k, caps_c["wall_max_c"] - AMBIENT_C)}
    caps_k |= {3: touched_k, 4: touched_k}
    return "", max(float(peaks_k[row]) / cap_k for row, cap_k in caps_k.items())


@pytest.mark.parametrize("count", [80, pytest.param(10_000, marks=[pytest.mark.slow, pytest.mark.timeout(7200)])])
def test_an_accepted_model_file_keeps_every_cap(count, tmp_path):
    shares, refusals = {}, Counter()
    for seed in range(count):
        refusal, share = judge(np.random.default_rng([7, seed]), tmp_path)
        if refusal:
            refusals[re.sub(r".*: |\d+", "", refusal.partition(": got")[0])] += 1
        else:
            shares[seed] = share
    closest = max(shares, key=shares.__getitem__)
    print(f"{len(shares)} accepted, the closest at {shares[closest]:.6f} of a cap; refused: {dict(refusals)}")
    assert shares[closest] <= 1.0 + TOLERANCE, closest
    assert len(shares) > 0.25 * count  # what is refused passes no cap either
    assert sum(share > 0.5 for share in shares.values()) > 0.4 * len(shares)  # the limiter still plays


@pytest.mark.parametrize("seed", [11, 17, 33, 72, 169, 229, 436, 448])
def test_what_once_passed_a_cap_or_ended_in_a_traceback(seed, tmp_path):
    """Found with: flows into a cold pixel, factors below darkness, and a memory that returns nothing."""
    assert judge(np.random.default_rng([7, seed]), tmp_path)[1] <= 1.0 + TOLERANCE


USUAL = {"R": 184.0, "C": 126e-6, "tau_g": 3e-3, "Rw": 20.0, "Cw": 0.06}
USUAL |= {"gas_share": 0.3, "wall_share": 0.4, "lag": 1.2}
TRAIN = FrameSequence((), (PulseTrain(0, 0.0, 1.0, 0.04, 0.004, FULL_W),))
STILL = 1.0, 1e9
"""A panel that stays cold, as the pixel's states are planned."""


def draw_stimulus(rng):
    """Return trains, or a height, on the pixel."""
    if rng.random() < 0.7:
        return draw_sequence(rng)
    return FrameSequence((TactileFrame("one", 0.0, 0.5, np.array([10 ** rng.uniform(-5.3, -3.5)])),), ())


def draw_mild_term(rng):
    """Return a term that any file may hold, over a range that the pixel may leave or not."""
    where = str(rng.choice(list(PLACES)))
    depends_on = str(rng.choice(PLACES[where][1]))
    high = {"power": FULL_W, "since_opening": 0.05, "absorber": 250.0}.get(depends_on, 150.0) * rng.uniform(0.3, 1.5)
    low = -high * rng.uniform(0.2, 1.0) if depends_on == "drive" else 0.0
    sizes = {
        "light": 0.2,
        "heat_capacity": 0.3,
        "absorber": -0.3 * high / USUAL["R"],
        "gas": -3e3,
        "displacement": 3e-5,
    }
    shape = [lambda z: z, lambda z: z**2, np.tanh, lambda z: np.sin(3.0 * z)][rng.integers(4)]
    values = sizes[where] * rng.random() * np.abs(shape(np.linspace(low, high, KNOTS) / high))
    values -= np.interp(0.0, np.linspace(low, high, KNOTS), values)
    more = {"memory_time_s": 0.02} if depends_on == "memory" else {}
    largest_w = FULL_W * float(rng.choice([1.0, 0.7], p=[0.8, 0.2]))
    return build_term(where, depends_on, low, high, values, max_power_w=largest_w, **more)


def find_outside(rng, folder):
    """Return why a drawn stimulus is refused, and the share of its range by which a term is left in its plan.

    The plan is that without the refusal. None if the set itself is refused, or the stimulus for another reason.
    """
    path, caps_c = folder / "model.toml", {"absorber_max_c": 400.0, "wall_max_c": 80.0, "touch_max_c": 80.0}
    terms, stimulus = [draw_mild_term(rng) for _ in range(int(rng.integers(1, 3)))], draw_stimulus(rng)
    write_model(path, USUAL, terms, has_wall=False)
    refusal = ""
    try:
        display = load_display(path, caps_c)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(extended_display, "check_reached", lambda *_: None)
            planned, _ = check_feasibility(display, stimulus, *display.build_cold_state())
    except InputError:
        return None
    try:
        display = load_display(path, caps_c)
        check_feasibility(display, stimulus, *display.build_cold_state())
    except InputError as error:
        refusal = str(error)
    peaks = find_peaks_k(planned.plan, USUAL, terms, has_wall=False, panel=STILL)
    largest_w = min(term["max_power_w"] for term in terms)
    return refusal, max(*peaks[5:], float(planned.plan.power_w.max(initial=0.0)) / largest_w - 1.0)


def judge_range(seeds, folder):
    """Return the refusals, the shares of what is accepted, and those of what is refused."""
    found = [each for seed in seeds if (each := find_outside(np.random.default_rng([8, seed]), folder)) is not None]
    refusals = [refusal for refusal, _ in found if refusal]
    return refusals, [share for refusal, share in found if not refusal], [share for refusal, share in found if refusal]


@pytest.mark.parametrize("count", [100, pytest.param(2000, marks=[pytest.mark.slow, pytest.mark.timeout(7200)])])
def test_a_plan_that_leaves_the_range_of_a_table_is_refused_in_one_line(count, tmp_path):
    refusals, accepted, refused = judge_range(range(count), tmp_path)
    print(f"{len(accepted)} accepted, at most {max(accepted):.4f} outside; {len(refused)} refused, {min(refused):.4f}")
    assert max(accepted) < 0.015  # 1 % of the range are permitted to the integrators
    assert min(refused) > 0.005
    assert min(len(accepted), len(refused)) > 0.1 * count
    for refusal in refusals:
        assert len(refusal) <= LINE_MAX
        place = r"pixel 0: .*: got \S+ \S+, expected .* to .*, the range of its data, .*"
        assert re.fullmatch(
            rf"{place}|frame one: target_um of pixel 0: .* the range of a discovered term's data", refusal
        )


ONE_PULSE = FrameSequence((), (PulseTrain(0, 0.0, 0.01, 0.003, 0.01, FULL_W),))


@pytest.mark.parametrize("is_mutant", [False, True])
def test_what_a_gas_reaches_after_the_last_pulse_counts(is_mutant, tmp_path, monkeypatch):
    """Also a mutant, which notes what is reached until the last gate closes."""
    path, caps_c = tmp_path / "model.toml", {"absorber_max_c": 400.0, "wall_max_c": 80.0, "touch_max_c": 80.0}
    write_model(path, USUAL, [build_term("displacement", "gas", 0.0, 500.0, [0.0] * KNOTS)], has_wall=False)
    display = load_display(path, caps_c)
    plan = check_feasibility(display, ONE_PULSE, *display.build_cold_state())[0].plan
    reached_k = find_peaks_k(plan, USUAL, [], has_wall=False, panel=STILL)[1]
    write_model(path, USUAL, [build_term("displacement", "gas", 0.0, 0.95 * reached_k, [0.0] * KNOTS)], has_wall=False)
    display = load_display(path, caps_c)
    if is_mutant:
        monkeypatch.setattr(extended_display, "add_peaks_after_off", lambda *_: None)
        check_feasibility(display, ONE_PULSE, *display.build_cold_state())
    else:
        with pytest.raises(
            InputError, match=r"pixel 0: gas of the discovered term in displacement: got .* K, expected 0 K to"
        ):
            check_feasibility(display, ONE_PULSE, *display.build_cold_state())


@pytest.mark.timeout(120)
def test_a_displacement_that_is_not_exactly_0_on_a_cold_pixel_ends_a_plan(tmp_path):
    write_model(tmp_path / "model.toml", USUAL, [build_term("displacement", "gas", 0.0, 200.0, [5e-12] * KNOTS)], False)
    display = load_display(tmp_path / "model.toml", {"absorber_max_c": 400.0, "wall_max_c": 80.0, "touch_max_c": 80.0})
    sequence = FrameSequence((TactileFrame("one", 0.0, 0.5, np.array([5e-5])),), ())
    assert len(check_feasibility(display, sequence, *display.build_cold_state())[0].plan)


OFFSET = [2.0, *[0.0] * (KNOTS - 2), -2.5e6]


def judge_usual(folder, terms, has_wall=False):
    caps_c = {"absorber_max_c": 400.0, "wall_max_c": 80.0, "touch_max_c": 43.0}
    return judge_set(folder / "model.toml", USUAL, terms, has_wall, False, caps_c, TRAIN)


@pytest.mark.parametrize("quantity", ["absorber", "memory"])
@pytest.mark.parametrize("has_wall", [False, True])
def test_a_flow_into_the_cold_that_is_small_beside_the_table_is_refused(quantity, has_wall, tmp_path):
    more = {"memory_time_s": 0.02} if quantity == "memory" else {}
    message, _ = judge_usual(tmp_path, [build_term("absorber", quantity, 0.0, 6.4e9, OFFSET, **more)], has_wall)
    assert "discovered.0.high: got 6400000000.0, expected -2000 to 2000 K" in message
    values = [5e-6, *[0.0] * (KNOTS - 2), -10.0]
    message, _ = judge_usual(tmp_path, [build_term("absorber", quantity, 0.0, 200.0, values, **more)], has_wall)
    assert f"discovered.0.values: got 5e-06, expected 0 W where {quantity} is 0" in message


def ignore_tails(slot, find=discovered_term._find_extremes):
    cut = slot.copy()
    cut[discovered_term.HEAD], cut[-1] = cut[discovered_term.HEAD + 1], cut[-2]
    return find(cut)


def return_early(feedback, ratio, find=discovered_term._find_late_feedback):
    return feedback**2 / find(feedback, ratio)


def test_mutant_zero_relative_to_the_table(tmp_path, monkeypatch):
    monkeypatch.setattr(discovered_term, "find_zero", lambda _: 1e-6 * 2.5e6)
    monkeypatch.setattr(discovered_term.DiscoveredTerm, "_check_plausible", lambda *_: None)
    assert judge_usual(tmp_path, [build_term("absorber", "absorber", 0.0, 6.4e9, OFFSET)])[1] > 1.5


def test_mutant_light_below_darkness(tmp_path, monkeypatch):
    monkeypatch.setattr(discovered_term.DiscoveredTerm, "_find_plausible_values", lambda _: (-10.0, 10.0))
    assert judge(np.random.default_rng([7, 169]), tmp_path)[1] > 1.5


@pytest.mark.parametrize(
    ("name", "mutant", "seed"),
    [("_find_extremes", ignore_tails, 95), ("_find_late_feedback", return_early, 25)],
    ids=["tails are ignored", "a memory returns heat before the absorber"],
)
def test_mutants_of_the_bound_are_caught(name, mutant, seed, tmp_path, monkeypatch):
    assert judge(np.random.default_rng([7, seed]), tmp_path)[1] <= 1.0 + TOLERANCE
    monkeypatch.setattr(discovered_term, name, mutant)
    assert judge(np.random.default_rng([7, seed]), tmp_path)[1] > 1.03
