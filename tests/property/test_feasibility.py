"""The feasibility check against an independent exhaustive search with its own clock in whole microseconds.

Both search the same class of schedules: every order of every frame's pixels, each pulse at its earliest start, a
train's pulse before any pulse that would delay it.
"""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from displays import DISPLAYS
from optodrive.core.errors import InputError, RefusedError
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.physics.nominal_display import NominalThermalState
from optodrive.planning.feasibility import check, order_search, violation
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.feasibility.reduction import omit_pixels, scale_sequence, stretch_sequence
from optodrive.planning.limiter.limiter import limit
from optodrive.planning.stimuli.train_json import check_trains

DISPLAY = DISPLAYS["display-16"]
SCAN_HEAD = DISPLAY.scan_head
X_RAD, Y_RAD = SCAN_HEAD.field.angles_rad(DISPLAY.layout.x_m, DISPLAY.layout.y_m)
LEAD_IN_US = SCAN_HEAD.settling.lead_in_us
TOLERANCE_US = 1e-3
SEEDS = st.integers(0, 2**32 - 1)


def settling_us(position, free, pixel):
    """Return the settling time to a pixel, µs.

    position: a pixel, and since when the gate was first on there
    """
    if position is None:
        return LEAD_IN_US
    origin, since = position
    return SCAN_HEAD.settling.settling_us(X_RAD[origin] - X_RAD[pixel], Y_RAD[origin] - Y_RAD[pixel], free - since)


def update_position(position, pixel, start):
    """Return the beam's position after a pulse from `start` on."""
    return position if position is not None and position[0] == pixel else (pixel, start)


def list_train_pulses(sequence):
    pulses = []
    for k, train in enumerate(sequence.trains):
        for start_s in train.pulse_starts_s():
            width_us = round(train.pulse_width_s * 1e6)
            pulses.append((LEAD_IN_US + round(start_s * 1e6), k, train.pixel, width_us, train.power_w))
    return sorted(pulses)


class ExhaustiveSearch:
    """Depth-first search over all schedules, pruned at the first miss."""

    def __init__(self, sequence, heat=None):
        self.frames = sequence.frames
        self.heat = heat or DISPLAY.build_cold_heat()
        self.pulses = list_train_pulses(sequence)

    def fits(self):
        return self.frame(0, 0, None, 0, self.heat)

    def train(self, free, position, done, heat):
        """Place the next train pulse. Return None if it is late by more than the settling time."""
        requested, _, pixel, width, power_w = self.pulses[done]
        move = settling_us(position, free, pixel)
        start = max(requested, free + move)
        if start > requested + move:
            return None
        heat.apply_pulse(pixel, start * 1e-6, width * 1e-6, power_w)
        return start + width, update_position(position, pixel, start), done + 1

    def frame(self, index, free, position, done, heat):
        until_us = LEAD_IN_US + (self.frames[index].show_at_s * 1e6 if index < len(self.frames) else np.inf)
        heat = heat.copy()
        while done < len(self.pulses) and self.pulses[done][0] < until_us:
            placed = self.train(free, position, done, heat)
            if placed is None:
                return False
            free, position, done = placed
        if index == len(self.frames):
            return True
        left = frozenset(np.flatnonzero(self.frames[index].target_m > 0).tolist())
        return self.pixels(index, left, free, position, done, heat)

    def pixels(self, index, left, free, position, done, heat):
        if not left:
            return self.frame(index + 1, free, position, done, heat)
        return any(self.pixel(index, pixel, left, free, position, done, heat.copy()) for pixel in sorted(left))

    def pixel(self, index, pixel, left, free, position, done, heat):
        frame = self.frames[index]
        while True:
            start = max(LEAD_IN_US + round(frame.show_at_s * 1e6), free + settling_us(position, free, pixel))
            pulse = heat.solve_pulse(pixel, start * 1e-6, float(frame.target_m[pixel]), SCAN_HEAD.drive)
            if pulse is None:
                return self.pixels(index, left - {pixel}, free, position, done, heat)
            end = start + round(pulse[0] * SCAN_HEAD.drive.period_s * 1e6)
            if done == len(self.pulses):
                break
            requested, _, following, _, _ = self.pulses[done]
            if end + settling_us(update_position(position, pixel, start), end, following) <= requested:
                break
            placed = self.train(free, position, done, heat)
            if placed is None:
                return False
            free, position, done = placed
        if end > LEAD_IN_US + (frame.show_at_s + frame.duration_s) * 1e6 + TOLERANCE_US:
            return False
        heat.apply_pulse(pixel, start * 1e-6, (end - start) * 1e-6, pulse[1] * SCAN_HEAD.drive.max_power_w)
        return self.pixels(index, left - {pixel}, end, update_position(position, pixel, start), done, heat)


def random_sequence(seed, trains_max=2):
    """Sample one to three frames of one to four pixels, and up to two trains, in about the time they need."""
    rng = np.random.default_rng(seed)
    pool = rng.choice(16, size=6, replace=False)
    trains = _random_trains(rng, pool, int(rng.integers(0, trains_max + 1)))
    fraction = min(0.5, sum(t.pulse_width_s / (t.pulse_width_s + t.gap_s) for t in trains))
    frames, at_s = [], 0.0
    for k in range(int(rng.integers(1, 4))):
        target_m, need_s = np.zeros(16), 0.0
        for pixel in rng.choice(pool, size=int(rng.integers(1, 5)), replace=False):
            target_m[pixel] = rng.uniform(20e-6, 160e-6)
            pulse = DISPLAY.build_cold_heat().solve_pulse(int(pixel), 0.0, target_m[pixel], SCAN_HEAD.drive)
            need_s += pulse[0] * SCAN_HEAD.drive.period_s + 0.0006
        duration_s = (need_s - 0.0006) * rng.uniform(0.96, 1.12) / (1.0 - fraction) + (0.002 if trains else 0.0)
        frames.append(TactileFrame(f"f{k}", at_s, duration_s, target_m, priority=int(rng.integers(0, 3))))
        at_s += duration_s + rng.choice([0.0, 0.0, 0.01])
    return FrameSequence(tuple(frames), trains)


def _random_trains(rng, pool, count):
    if count == 2 and rng.random() < 0.2:  # abutting, so that the settling times between them add up
        width_s, pair = 2e-4 * int(rng.integers(2, 8)), rng.choice(pool, size=2, replace=False)
        last_s = width_s * int(rng.integers(1, 5))
        return tuple(PulseTrain(int(p), k * width_s, last_s, width_s, width_s, 0.5) for k, p in enumerate(pair))
    trains = ()
    for _ in range(count):
        width_s, gap_s = 2e-4 * int(rng.integers(1, 12)), rng.uniform(0.006, 0.03)
        power_w, priority = rng.uniform(0.2, 1.0), int(rng.integers(0, 3))
        train = PulseTrain(
            int(rng.choice(pool)), rng.uniform(0, 0.01), rng.uniform(0.005, 0.06), width_s, gap_s, power_w, priority
        )
        try:
            check_trains([*trains, train], "trains", DISPLAY.config)
        except InputError:
            continue
        trains += (train,)
    return trains


def random_heat(seed):
    """Return a cold display for every other seed, else one heated until shortly before, so that the gas still warms."""
    heat = NominalThermalState(DISPLAY.pixels, -0.1)
    rng = np.random.default_rng([seed, 1])
    for pixel in range(16) if seed % 2 else ():
        width_s = rng.uniform(1e-3, 1e-2)
        heat.apply_pulse(pixel, -width_s - rng.choice([0.0, 0.002, 0.02]), width_s, rng.uniform(0.0, 2.45))
    return heat


def find_misses(sequence, planned):
    """Return the misses of a plan, computed from its columns and the sequence, and verify it with the limiter."""
    plan, found = planned.plan, []
    end_us = (plan.start_s + plan.width_s) * 1e6
    for source, frame in enumerate(sequence.frames):
        own = plan.source == source
        deadline_us = LEAD_IN_US + (frame.show_at_s + frame.duration_s) * 1e6
        found += [f"frame {source} late"] if (end_us[own] > deadline_us + TOLERANCE_US).any() else []
        skipped = {item.pixel for item in planned.skipped if item.source == source}
        shown = set(plan.pixel[own].tolist()) | skipped
        found += [f"frame {source} lacks pixels"] if shown != set(np.flatnonzero(frame.target_m).tolist()) else []
    requested_us = [pulse[0] for pulse in list_train_pulses(sequence)]
    position, free, done = None, 0, 0
    for source, pixel, start, end in zip(plan.source, plan.pixel, plan.start_s * 1e6, end_us, strict=True):
        if source >= len(sequence.frames):
            late_us = start - requested_us[done]
            found += (
                ["a train's pulse late"] if late_us > settling_us(position, free, int(pixel)) + TOLERANCE_US else []
            )
            done += 1
        position, free = update_position(position, int(pixel), round(start)), round(end)
    found += ["trains lack pulses"] if done != len(requested_us) else []
    limit(plan, DISPLAY.build_cold_state()[1], DISPLAY.budget, "refuse")
    return found


def check_agreement(seed):
    """Assert that the check and the exhaustive search agree, and return the report."""
    sequence = random_sequence(seed)
    heat, budget = random_heat(seed), DISPLAY.build_cold_state()[1]
    planned, report = check_feasibility(DISPLAY, sequence, heat, budget)
    assert report.reason in (None, "deadline")
    assert report.fits == ExhaustiveSearch(sequence, heat).fits(), (seed, report.message)
    if report.fits:
        assert find_misses(sequence, planned) == []
        for source, frame in enumerate(sequence.frames):
            bound_s = order_search.beam_lower_bound_s(DISPLAY, sequence, heat, source, LEAD_IN_US * 1e-6)
            assert bound_s <= frame.duration_s + 1e-6, (seed, source)
    else:
        assert report.proof in ("searched", "bound")
    return report


@settings(max_examples=2 * settings.default.max_examples)
@given(SEEDS)
def test_the_verdict_agrees_with_an_exhaustive_search(seed):
    check_agreement(seed)


@pytest.mark.slow
def test_both_verdicts_are_common_among_the_seeds():
    """The seeds are fixed, because hypothesis draws its own distribution."""
    fits = [check_agreement(seed).fits for seed in range(100)]
    assert 25 < sum(fits) < 75


@settings(max_examples=3 * settings.default.max_examples // 5)
@given(SEEDS)
def test_the_nearest_feasible_variants_fit(seed):
    sequence = random_sequence(seed)
    nearest = check_feasibility(DISPLAY, sequence, *DISPLAY.build_cold_state())[1].nearest
    if nearest is None:
        return
    offered = []
    if nearest.height_factor is not None:
        offered.append(scale_sequence(sequence, nearest.height_factor))
        if nearest.complete and nearest.height_factor < 0.99:
            assert not ExhaustiveSearch(scale_sequence(sequence, round(nearest.height_factor * 100 + 1) / 100)).fits()
    if nearest.time_factor is not None:
        offered.append(stretch_sequence(sequence, nearest.time_factor))
    if nearest.pixels is not None:
        omitted = {item.source: item.pixels for item in nearest.pixels.omitted}
        offered.append(omit_pixels(sequence, omitted))
        if nearest.complete and len(sequence.frames) == 1 and not sequence.trains:
            pixels = np.flatnonzero(sequence.frames[0].target_m).tolist()
            fewer = combinations(pixels, len(omitted[0]) - 1)
            assert not any(ExhaustiveSearch(omit_pixels(sequence, {0: left})).fits() for left in fewer)
    for other in offered:
        planned, report = check_feasibility(DISPLAY, other, *DISPLAY.build_cold_state())
        assert report.fits
        assert find_misses(other, planned) == []


@pytest.mark.parametrize("fit", ["even", "priority"])
@settings(max_examples=2 * settings.default.max_examples // 5)
@given(seed=SEEDS)
def test_best_effort_fits_or_is_refused(fit, seed):
    sequence = random_sequence(seed)
    nearest = check_feasibility(DISPLAY, sequence, *DISPLAY.build_cold_state())[1].nearest
    if nearest is not None and (nearest.height_factor if fit == "even" else nearest.pixels) is None:
        with pytest.raises(RefusedError, match="fits"):
            check_feasibility(DISPLAY, sequence, *DISPLAY.build_cold_state(), fit=fit)
        return
    planned, report = check_feasibility(DISPLAY, sequence, *DISPLAY.build_cold_state(), fit=fit)
    shown = omit_pixels(
        scale_sequence(sequence, report.height_factor), {item.source: item.pixels for item in report.omitted}
    )
    assert find_misses(shown, planned) == []
    assert report.fits == (report.height_factor == 1.0 and not report.omitted)


def _last_deadline_ignored(monkeypatch):
    true = violation.deadlines_s

    def ignoring(sequence, lead_in_s):
        deadline_s = true(sequence, lead_in_s)
        deadline_s[-1:] = np.inf
        return deadline_s

    for module in (order_search, check):
        monkeypatch.setattr(module, "deadlines_s", ignoring)


def _planner_order_only(monkeypatch):
    monkeypatch.setattr(order_search.OrderSearch, "_search_depth_first", lambda self, sequence: None)


def _lower_bound_too_high(monkeypatch):
    true = order_search.beam_lower_bound_s
    monkeypatch.setattr(order_search, "beam_lower_bound_s", lambda *given: 1.05 * true(*given))


def _orders_skipped(monkeypatch):
    true = order_search._locate_violation

    def too_early(*given):
        source, place = true(*given)
        return source, max(0, place - 2)

    monkeypatch.setattr(order_search, "_locate_violation", too_early)


def _late_trains_accepted(monkeypatch):
    true = violation.find_first_violation

    def lenient(plan, deadline_s):
        found = true(plan, deadline_s)
        return None if found is not None and found.source >= len(deadline_s) else found

    for module in (order_search, check):
        monkeypatch.setattr(module, "find_first_violation", lenient)


MUTANTS = (
    _last_deadline_ignored,
    _planner_order_only,
    _lower_bound_too_high,
    _orders_skipped,
    _late_trains_accepted,
)


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_faulty_feasibility_check_is_caught(mutant, monkeypatch):
    mutant(monkeypatch)
    with pytest.raises(AssertionError):
        all(check_agreement(seed) for seed in range(400))
