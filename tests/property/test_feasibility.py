"""Admission against a search of this file's own: its own loop over all orders, its own clock in whole microseconds.

Both look at the same class of schedules: every order of every frame's pixels, each pulse as early as it may come, a
train's pulse before any pulse that would make it late.
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
from optodrive.planning.feasibility.sequence_edits import omit_pixels, scale_sequence, stretch_sequence
from optodrive.planning.limiter.limiter import limit
from optodrive.planning.stimuli.train_json import check_trains

DISPLAY = DISPLAYS["display-16"]
MACHINE = DISPLAY.scan_head
X_RAD, Y_RAD = MACHINE.field.angles_rad(DISPLAY.layout.x_m, DISPLAY.layout.y_m)
LEAD_US = MACHINE.settling.lead_in_us
SLACK_US = 1e-3
SEEDS = st.integers(0, 2**32 - 1)


def settling_us(position, free, pixel):
    """The move to a pixel from where the beam stands: a pixel, and since when the gate was first open there, µs."""
    if position is None:
        return LEAD_US
    origin, since = position
    return MACHINE.settling.settling_us(X_RAD[origin] - X_RAD[pixel], Y_RAD[origin] - Y_RAD[pixel], free - since)


def update_position(position, pixel, start):
    """Where the beam stands after it was lit from `start` on."""
    return position if position is not None and position[0] == pixel else (pixel, start)


def list_train_pulses(sequence):
    pulses = []
    for k, train in enumerate(sequence.trains):
        for start_s in train.pulse_starts_s():
            width_us = round(train.pulse_width_s * 1e6)
            pulses.append((LEAD_US + round(start_s * 1e6), k, train.pixel, width_us, train.power_w))
    return sorted(pulses)


class ExhaustiveSearch:
    """Depth first over everything the beam can do, cut off at the first miss."""

    def __init__(self, sequence, heat=None):
        self.frames = sequence.frames
        self.heat = heat or DISPLAY.build_cold_heat()
        self.pulses = list_train_pulses(sequence)

    def fits(self):
        return self.frame(0, 0, None, 0, self.heat)

    def train(self, free, stand, done, heat):
        """Place the next train pulse; None where it comes late by more than the move to it."""
        due, _, pixel, width, power_w = self.pulses[done]
        move = settling_us(stand, free, pixel)
        start = max(due, free + move)
        if start > due + move:
            return None
        heat.apply_pulse(pixel, start * 1e-6, width * 1e-6, power_w)
        return start + width, update_position(stand, pixel, start), done + 1

    def frame(self, index, free, stand, done, heat):
        until_us = LEAD_US + (self.frames[index].show_at_s * 1e6 if index < len(self.frames) else np.inf)
        heat = heat.copy()
        while done < len(self.pulses) and self.pulses[done][0] < until_us:
            placed = self.train(free, stand, done, heat)
            if placed is None:
                return False
            free, stand, done = placed
        if index == len(self.frames):
            return True
        left = frozenset(np.flatnonzero(self.frames[index].target_m > 0).tolist())
        return self.pixels(index, left, free, stand, done, heat)

    def pixels(self, index, left, free, stand, done, heat):
        if not left:
            return self.frame(index + 1, free, stand, done, heat)
        return any(self.pixel(index, pixel, left, free, stand, done, heat.copy()) for pixel in sorted(left))

    def pixel(self, index, pixel, left, free, stand, done, heat):
        frame = self.frames[index]
        while True:
            start = max(LEAD_US + round(frame.show_at_s * 1e6), free + settling_us(stand, free, pixel))
            pulse = heat.solve_pulse(pixel, start * 1e-6, float(frame.target_m[pixel]), MACHINE.drive)
            if pulse is None:
                return self.pixels(index, left - {pixel}, free, stand, done, heat)
            end = start + round(pulse[0] * MACHINE.drive.period_s * 1e6)
            if done == len(self.pulses):
                break
            due, _, following, _, _ = self.pulses[done]
            if end + settling_us(update_position(stand, pixel, start), end, following) <= due:
                break
            placed = self.train(free, stand, done, heat)
            if placed is None:
                return False
            free, stand, done = placed
        if end > LEAD_US + (frame.show_at_s + frame.duration_s) * 1e6 + SLACK_US:
            return False
        heat.apply_pulse(pixel, start * 1e-6, (end - start) * 1e-6, pulse[1] * MACHINE.drive.max_power_w)
        return self.pixels(index, left - {pixel}, end, update_position(stand, pixel, start), done, heat)


def random_sequence(seed, trains_max=2):
    """One to three frames of one to four pixels, up to two trains, in about the time they need."""
    rng = np.random.default_rng(seed)
    pool = rng.choice(16, size=6, replace=False)
    trains = _random_trains(rng, pool, int(rng.integers(0, trains_max + 1)))
    share = min(0.5, sum(t.pulse_width_s / (t.pulse_width_s + t.gap_s) for t in trains))
    frames, at_s = [], 0.0
    for k in range(int(rng.integers(1, 4))):
        target_m, need_s = np.zeros(16), 0.0
        for pixel in rng.choice(pool, size=int(rng.integers(1, 5)), replace=False):
            target_m[pixel] = rng.uniform(20e-6, 160e-6)
            at_rest = DISPLAY.build_cold_heat().solve_pulse(int(pixel), 0.0, target_m[pixel], MACHINE.drive)
            need_s += at_rest[0] * MACHINE.drive.period_s + 0.0006
        duration_s = (need_s - 0.0006) * rng.uniform(0.96, 1.12) / (1.0 - share) + (0.002 if trains else 0.0)
        frames.append(TactileFrame(f"f{k}", at_s, duration_s, target_m, priority=int(rng.integers(0, 3))))
        at_s += duration_s + rng.choice([0.0, 0.0, 0.01])
    return FrameSequence(tuple(frames), trains)


def _random_trains(rng, pool, count):
    if count == 2 and rng.random() < 0.2:  # abutting, so that the moves between them add up
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
    """Every other time a display at rest; else pixels were lit until shortly before, so that the gas still rises."""
    heat = NominalThermalState(DISPLAY.pixels, -0.1)
    rng = np.random.default_rng([seed, 1])
    for pixel in range(16) if seed % 2 else ():
        width_s = rng.uniform(1e-3, 1e-2)
        heat.apply_pulse(pixel, -width_s - rng.choice([0.0, 0.002, 0.02]), width_s, rng.uniform(0.0, 2.45))
    return heat


def find_misses(sequence, prepared):
    """What a plan misses of a sequence, reckoned here from the plan's columns, and through the limiter once more."""
    plan, found = prepared.plan, []
    end_us = (plan.start_s + plan.width_s) * 1e6
    for source, frame in enumerate(sequence.frames):
        own = plan.source == source
        due_us = LEAD_US + (frame.show_at_s + frame.duration_s) * 1e6
        found += [f"frame {source} late"] if (end_us[own] > due_us + SLACK_US).any() else []
        skipped = {item.pixel for item in prepared.skipped if item.source == source}
        shown = set(plan.pixel[own].tolist()) | skipped
        found += [f"frame {source} lacks pixels"] if shown != set(np.flatnonzero(frame.target_m).tolist()) else []
    nominal_us = [pulse[0] for pulse in list_train_pulses(sequence)]
    stand, free, done = None, 0, 0
    for source, pixel, start, end in zip(plan.source, plan.pixel, plan.start_s * 1e6, end_us, strict=True):
        if source >= len(sequence.frames):
            late_us = start - nominal_us[done]
            found += ["a train's pulse late"] if late_us > settling_us(stand, free, int(pixel)) + SLACK_US else []
            done += 1
        stand, free = update_position(stand, int(pixel), round(start)), round(end)
    found += ["trains lack pulses"] if done != len(nominal_us) else []
    limit(plan, DISPLAY.build_cold_state()[1], DISPLAY.budget, "refuse")
    return found


def check_agreement(seed):
    """Whether admission and the search here say the same; the answer."""
    sequence = random_sequence(seed)
    heat, budget = random_heat(seed), DISPLAY.build_cold_state()[1]
    prepared, report = check_feasibility(DISPLAY, sequence, heat, budget)
    assert report.reason in (None, "deadline")
    assert report.fits == ExhaustiveSearch(sequence, heat).fits(), (seed, report.message)
    if report.fits:
        assert find_misses(sequence, prepared) == []
        for source, frame in enumerate(sequence.frames):
            bound_s = order_search.beam_lower_bound_s(DISPLAY, sequence, heat, source, LEAD_US * 1e-6)
            assert bound_s <= frame.duration_s + 1e-6, (seed, source)
    else:
        assert report.proof in ("searched", "bound")
    return report


@settings(max_examples=200)
@given(SEEDS)
def test_yes_and_no_agree_with_an_exhaustive_search(seed):
    check_agreement(seed)


def test_both_answers_are_common_among_the_seeds():
    """The same seeds in every run: what hypothesis draws, and how often, is its own."""
    fits = [check_agreement(seed).fits for seed in range(100)]
    assert 25 < sum(fits) < 75


@settings(max_examples=60)
@given(SEEDS)
def test_what_is_suggested_fits_when_it_is_asked_for(seed):
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
        left_out = {item.source: item.pixels for item in nearest.pixels.omitted}
        offered.append(omit_pixels(sequence, left_out))
        if nearest.complete and len(sequence.frames) == 1 and not sequence.trains:
            pixels = np.flatnonzero(sequence.frames[0].target_m).tolist()
            fewer = combinations(pixels, len(left_out[0]) - 1)
            assert not any(ExhaustiveSearch(omit_pixels(sequence, {0: left})).fits() for left in fewer)
    for other in offered:
        prepared, admission = check_feasibility(DISPLAY, other, *DISPLAY.build_cold_state())
        assert admission.fits
        assert find_misses(other, prepared) == []


@pytest.mark.parametrize("fit", ["even", "priority"])
@settings(max_examples=40)
@given(seed=SEEDS)
def test_best_effort_fits_or_says_that_nothing_does(fit, seed):
    sequence = random_sequence(seed)
    nearest = check_feasibility(DISPLAY, sequence, *DISPLAY.build_cold_state())[1].nearest
    if nearest is not None and (nearest.height_factor if fit == "even" else nearest.pixels) is None:
        with pytest.raises(RefusedError, match="fits"):
            check_feasibility(DISPLAY, sequence, *DISPLAY.build_cold_state(), fit=fit)
        return
    prepared, admission = check_feasibility(DISPLAY, sequence, *DISPLAY.build_cold_state(), fit=fit)
    shown = omit_pixels(
        scale_sequence(sequence, admission.height_factor), {item.source: item.pixels for item in admission.omitted}
    )
    assert find_misses(shown, prepared) == []
    assert admission.fits == (admission.height_factor == 1.0 and not admission.omitted)


def _last_deadline_ignored(monkeypatch):
    true = violation.deadlines_s

    def ignoring(sequence, lead_s):
        due_s = true(sequence, lead_s)
        due_s[-1:] = np.inf
        return due_s

    for module in (order_search, check):
        monkeypatch.setattr(module, "deadlines_s", ignoring)


def _only_the_planners_order(monkeypatch):
    monkeypatch.setattr(order_search.OrderSearch, "_search_depth_first", lambda self, sequence: None)


def _bound_too_high(monkeypatch):
    true = order_search.beam_lower_bound_s
    monkeypatch.setattr(order_search, "beam_lower_bound_s", lambda *given: 1.05 * true(*given))


def _orders_passed_over(monkeypatch):
    true = order_search._locate_violation

    def too_early(*given):
        source, place = true(*given)
        return source, max(0, place - 2)

    monkeypatch.setattr(order_search, "_locate_violation", too_early)


def _trains_may_be_late(monkeypatch):
    true = violation.find_first_violation

    def lenient(plan, due_s):
        found = true(plan, due_s)
        return None if found is not None and found.source >= len(due_s) else found

    for module in (order_search, check):
        monkeypatch.setattr(module, "find_first_violation", lenient)


MUTANTS = (
    _last_deadline_ignored,
    _only_the_planners_order,
    _bound_too_high,
    _orders_passed_over,
    _trains_may_be_late,
)


@pytest.mark.parametrize("mutant", MUTANTS)
def test_an_admission_that_is_wrong_is_caught(mutant, monkeypatch):
    mutant(monkeypatch)
    with pytest.raises(AssertionError):
        all(check_agreement(seed) for seed in range(400))
