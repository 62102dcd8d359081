"""Who breaks it, what is proven, what would fit, and what each face of refusal carries."""

import json
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError, OverBudgetError, RefusedError
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame
from optodrive.planning.feasibility import order_search
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.feasibility.sequence_edits import omit_pixels, scale_sequence, stretch_sequence
from optodrive.planning.feasibility.violation import beam_lower_bound_s
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.stimuli.pattern_registry import build_pattern
from optodrive.planning.stimuli.train_json import check_trains

DISPLAY = DISPLAYS["display-437"]


def build_frame(pixels, height_um=100.0, show_at_s=0.0, duration_s=1.0, name="f", priority=0):
    target_m = np.zeros(len(DISPLAY.layout))
    target_m[list(pixels)] = np.array(height_um) * 1e-6
    return TactileFrame(name, show_at_s, duration_s, target_m, priority=priority)


def check(*frames, trains=(), display=DISPLAY, **how):
    return check_feasibility(display, FrameSequence(tuple(frames), tuple(trains)), *display.build_cold_state(), **how)


def with_caps(**caps):
    return replace(DISPLAY, budget=DISPLAY.budget._replace(caps=DISPLAY.budget.caps._replace(**caps)))


LATE_FRAME = build_frame(range(40), duration_s=0.1)
HOT_FRAMES = [build_frame([200, 201], 300, 0.1 * k, 0.1, f"f{k}") for k in range(6)]


def test_what_fits_costs_its_plan_and_no_more():
    prepared, admission = check(build_frame(range(20)))
    assert admission.fits
    assert admission.proof == "planned"
    assert admission.plans_tried == 0
    assert 0 < admission.beam_required_s < admission.beam_available_s == pytest.approx(1.0)
    alone = plan_sequence(DISPLAY, prepared.sequence, *DISPLAY.build_cold_state())
    assert np.array_equal(prepared.plan.start_s, alone.plan.start_s)


def test_a_late_frame_is_named_with_what_it_needs_and_what_fits():
    prepared, admission = check(LATE_FRAME)
    assert not admission.fits
    assert (admission.proof, admission.reason, admission.name) == ("bound", "deadline", "f")
    assert admission.beam_required_s == pytest.approx(0.1 + prepared.frames[0].late_s)
    assert admission.beam_available_s == pytest.approx(0.1)
    assert 0.1 < admission.beam_lower_bound_s <= admission.beam_required_s
    assert admission.plans_tried <= admission.plans_tried_max
    nearest = admission.nearest
    assert nearest.complete
    assert nearest.pixels.kept + len(nearest.pixels.omitted[0].pixels) == nearest.pixels.requested == 40
    assert nearest.time_factor == pytest.approx(admission.beam_required_s / 0.1, rel=0.02)
    for word in ("needs", "takes at least", f"{nearest.pixels.kept} of 40 pixels", f"× {nearest.height_factor:g}"):
        assert word in admission.message
    assert json.loads(json.dumps(admission.to_dict()))["nearest"]["time_factor"] == nearest.time_factor


def test_an_order_that_fits_is_found_and_played():
    """The long pulse does not fit before the train's, the short one does."""
    train = PulseTrain(9, 0.0045, 0.001, 0.001, 0.001, 0.5)
    both = build_frame([0, 1], [100.0, 40.0], duration_s=0.0134)
    sequence = FrameSequence((both,), (train,))
    late = plan_sequence(DISPLAY, sequence, *DISPLAY.build_cold_state())
    assert late.frames[0].late_s > 0
    prepared, admission = check(both, trains=[train])
    assert admission.fits
    assert admission.proof == "searched"
    assert admission.plans_tried <= 3
    assert prepared.plan.pixel.tolist() == [1, 9, 0]
    assert prepared.frames[0].late_s == 0


def test_a_frame_that_is_nearly_late_is_searched_through():
    first = build_frame([0, 1, 2], 100, duration_s=0.02)
    _, admission = check(first, replace(first, frame_id="again", show_at_s=0.02, duration_s=0.003))
    assert (admission.fits, admission.proof, admission.name) == (False, "searched", "again")
    assert admission.plans_tried > 6


def test_nothing_is_claimed_beyond_what_was_shown():
    """The second frame's pixels have been lit: the bound does not know their heat, and the orders are too many."""
    first = build_frame(range(30), 60, 0.0, 0.2, "a")
    _, admission = check(first, build_frame(range(30), 60, 0.2, 0.09, "b"))
    assert (admission.fits, admission.proof, admission.name) == (False, "not found", "b")
    assert "does not prove" in admission.message
    assert admission.beam_required_s > admission.beam_available_s


def test_the_bound_claims_nothing_with_terms_in_the_model():
    terms = replace(DISPLAY, parameters=DISPLAY.parameters.model_copy(update={"planner_terms": ("droop",)}))
    given = FrameSequence((LATE_FRAME,)), DISPLAY.build_cold_heat(), 0, 0.002
    assert beam_lower_bound_s(terms, *given) is None
    assert beam_lower_bound_s(DISPLAY, *given) > 0.1


def test_pixels_lit_before_are_not_counted_in_the_bound():
    given = DISPLAY.build_cold_heat(), 1, 0.002
    alone = beam_lower_bound_s(
        DISPLAY, FrameSequence((build_frame([5], name="a"), build_frame([6, 7], show_at_s=1.0))), *given
    )
    shared = beam_lower_bound_s(
        DISPLAY, FrameSequence((build_frame([6], name="a"), build_frame([6, 7], show_at_s=1.0))), *given
    )
    of_train = FrameSequence(
        (build_frame([5]), build_frame([6, 7], show_at_s=1.0)), (PulseTrain(6, 0, 0.1, 0.01, 0.01, 1.0),)
    )
    assert shared < 0.6 * alone
    assert beam_lower_bound_s(DISPLAY, of_train, *given) == pytest.approx(shared)


def test_a_cap_is_named_as_what_breaks_it():
    prepared, admission = check(*HOT_FRAMES, display=with_caps(touch_k=2.0))
    assert not admission.fits
    assert admission.reason == "touch_temperature"
    assert admission.pixel == prepared.shortfall.pixel
    assert "touch surface temperature cap" in admission.message
    assert 0 < admission.nearest.height_factor < 1 < admission.nearest.time_factor


def test_refuse_carries_the_admission():
    with pytest.raises(RefusedError, match="nearest feasible") as late:
        check(LATE_FRAME, policy="refuse")
    assert late.value.code == "refused"
    assert late.value.feasibility["name"] == "f"
    with pytest.raises(OverBudgetError) as hot:
        check(*HOT_FRAMES, display=with_caps(touch_k=2.0), policy="refuse")
    assert hot.value.feasibility["reason"] == "touch_temperature"


def test_delay_waits_and_says_that_it_did_not_fit():
    prepared, admission = check(*HOT_FRAMES, display=with_caps(touch_k=2.0), policy="delay")
    assert prepared.delays
    assert not prepared.plan.trimmed_j.any()
    assert admission.reason == "touch_temperature"
    with pytest.raises(OverBudgetError) as never:
        check(HOT_FRAMES[0], display=with_caps(absorber_k=60.0), policy="delay")
    assert never.value.feasibility["reason"] == "absorber_temperature"


@pytest.mark.parametrize("how", [{"display": with_caps(touch_k=2.0)}, {}])
@pytest.mark.parametrize("fit", ["even", "priority"])
def test_best_effort_passes_every_policy(fit, how):
    frames = HOT_FRAMES if how else [LATE_FRAME]
    prepared, admission = check(*frames, fit=fit, policy="refuse", **how)
    assert not admission.fits
    assert (admission.height_factor < 1) == (fit == "even")
    assert bool(admission.omitted) == (fit == "priority")
    assert not prepared.plan.trimmed_j.any()
    assert all(timing.late_s == 0 for timing in prepared.frames)


def test_out_of_reach_is_refused_as_it_is_and_mended_on_request():
    with pytest.raises(InputError, match="target_um of pixel 3"):
        check(build_frame([3], 5000))
    _, lower = check(build_frame([3, 4], [1000, 100]), fit="even")
    assert lower.reason == "unreachable"
    assert lower.height_factor == pytest.approx(0.5, abs=0.02)
    prepared, fewer = check(build_frame([3, 4], [1000, 100]), fit="priority")
    assert [(item.name, item.pixels) for item in fewer.omitted] == [("f", (3,))]
    assert prepared.plan.pixel.tolist() == [4]
    with pytest.raises(RefusedError, match="no part of it fits"):
        check(build_frame([3], 1000), fit="priority")


def test_the_more_important_stays():
    """A train that leaves a frame no time: whichever matters less goes."""
    train = PulseTrain(9, 0.0, 0.1, 0.02, 0.005, 0.3)
    _, first = check(build_frame([0, 1], 200, duration_s=0.05, priority=1), trains=[train], fit="priority")
    assert [(item.name, item.pixels) for item in first.omitted] == [("train 0", (9,))]
    _, second = check(build_frame([0, 1], 200, duration_s=0.05), trains=[replace(train, priority=1)], fit="priority")
    assert [(item.name, item.pixels) for item in second.omitted] == [("f", (0, 1))]


def test_a_large_frame_loses_few_pixels():
    target_um = np.linspace(20, 120, 60)
    _, admission = check(build_frame(range(60), target_um, duration_s=0.22), fit="priority")
    (left,) = admission.omitted
    assert max(left.pixels) == 59
    assert len(left.pixels) < 20


def test_a_long_animation_is_thinned_in_rounds():
    frames = [build_frame(range(k % 7, 40 + k % 7), 60 + k % 5, 0.12 * k, 0.12, f"f{k}") for k in range(100)]
    prepared, admission = check(*frames, fit="priority")
    assert len(admission.omitted) > 50
    assert 0.6 * 4000 < len(prepared.plan) < 4000
    assert all(timing.late_s == 0 for timing in prepared.frames)


def test_nothing_is_tried_any_more_when_the_plans_are_spent(monkeypatch):
    """What is tried without a plan shows no progress, and costs the lease where it lasts."""
    tried = []
    true = order_search.OrderSearch.find_orders
    monkeypatch.setattr(
        order_search.OrderSearch, "find_orders", lambda self, sequence: tried.append(1) or true(self, sequence)
    )
    monkeypatch.setattr("optodrive.planning.feasibility.check.PULSES_REQUESTED_MAX", 0)
    frames = [build_frame(range(40), 60, 0.11 * k, 0.11, f"f{k}") for k in range(50)]
    _, admission = check(*frames, fit="priority")
    assert not admission.nearest.complete
    assert sum(len(item.pixels) for item in admission.omitted) > 200
    assert len(tried) < 80


def test_trains_whose_moves_add_up_do_not_fit_and_one_move_does():
    trains = [PulseTrain(200 + k, 0.015 * k, 0.015, 0.015, 0.015, 1.0) for k in range(3)]
    assert check(trains=trains[:2])[1].fits
    _, admission = check(trains=trains)
    assert (admission.fits, admission.proof, admission.name) == (False, "bound", "train 2")
    assert admission.beam_required_s > admission.beam_available_s > 0.015
    assert admission.nearest.height_factor is None
    with pytest.raises(RefusedError, match="no height fits"):
        check(trains=trains, fit="even")
    slower = stretch_sequence(build_pattern("experiment-6", {}, DISPLAY.config), 1.06)
    assert check_feasibility(DISPLAY, slower, *DISPLAY.build_cold_state())[1].fits


def test_progress_is_shown_while_orders_are_searched():
    told = []
    frames = [build_frame(range(4 * k, 4 * k + 4), 100, 0.05 * k, 0.05 if k < 1 else 0.0245, f"f{k}") for k in range(2)]
    _, admission = check(*frames, trains=[PulseTrain(9, 0.0501, 0.02, 0.0004, 0.003, 0.3)], on_progress=told.append)
    assert admission.plans_tried > 20
    assert len(told) > admission.plans_tried


def test_a_search_ends_at_its_bound_and_proves_nothing(monkeypatch):
    monkeypatch.setattr("optodrive.planning.feasibility.check.ORDERS_MAX", 5)
    monkeypatch.setattr("optodrive.planning.feasibility.check.count_orders", lambda sequence: 1)
    monkeypatch.setattr(order_search, "beam_lower_bound_s", lambda *given: None)
    _, admission = check(build_frame(range(4), 100, duration_s=0.02))
    assert (admission.fits, admission.proof) == (False, "not found")


def test_every_order_is_visited_once():
    ranks, seen = [[0, 1, 2], [], [0, 1]], set()
    while True:
        seen.add(tuple(map(tuple, ranks)))
        if not order_search._advance_orders(ranks, 2, 1):
            break
    assert seen == {(first, (), last) for first in permutations(range(3)) for last in permutations(range(2))}


def test_orders_that_begin_alike_are_passed_over():
    ranks = [[0, 1, 2, 3]]
    firsts = []
    while order_search._advance_orders(ranks, 0, 0):
        firsts.append(ranks[0][0])
    assert firsts == [1, 2, 3]


def test_changes_keep_what_they_do_not_change():
    trains = (PulseTrain(3, 0.1, 0.4, 0.02, 0.02, 1.0), PulseTrain(4, 0.32, 0.02, 0.02, 0.02, 2.0, 5))
    sequence = FrameSequence((build_frame([1, 2], priority=3),), trains)
    slow = stretch_sequence(sequence, 2.0)
    check_trains(slow.trains, "trains", DISPLAY.config)
    assert [len(train.pulse_starts_s()) for train in slow.trains] == [10, 1]
    assert slow.trains[0].pulse_starts_s() == pytest.approx(2.0 * trains[0].pulse_starts_s())
    assert (slow.frames[0].duration_s, slow.frames[0].priority, slow.trains[1].priority) == (2.0, 3, 5)
    assert scale_sequence(sequence, 0.5).trains[1].power_w == 1.0
    assert scale_sequence(sequence, 0.5).frames[0].target_m.max() == pytest.approx(50e-6)
    fewer = omit_pixels(sequence, {0: (1,), 2: (4,)})
    assert np.flatnonzero(fewer.frames[0].target_m).tolist() == [2]
    assert fewer.trains == trains[:1]


def test_trains_by_height_are_made_lower_and_slower_as_a_whole():
    train = HeightTrain(3, 0.1, 0.4, 0.04, 300e-6, 100e-6, priority=2)
    sequence = FrameSequence((), (train,))
    assert scale_sequence(sequence, 0.5).trains == (replace(train, target_m=150e-6, peak_to_peak_m=50e-6),)
    assert stretch_sequence(sequence, 2.0).trains == (replace(train, start_s=0.2, duration_s=0.8, period_s=0.08),)


def test_a_train_by_height_takes_its_time_from_a_frame():
    """Both do not fit at full height; what is suggested does, though the train has other cycles then."""
    train = HeightTrain(9, 0.0, 0.5, 0.025, 250e-6, 60e-6)
    _, alone = check(build_frame(range(30), 60, duration_s=0.14))
    assert alone.fits
    _, admission = check(build_frame(range(30), 60, duration_s=0.14), trains=[train])
    assert (admission.fits, admission.name) == (False, "f")
    assert admission.nearest.height_factor is not None
    lower = scale_sequence(
        FrameSequence((build_frame(range(30), 60, duration_s=0.14),), (train,)), admission.nearest.height_factor
    )
    assert check_feasibility(DISPLAY, lower, *DISPLAY.build_cold_state())[1].fits
    assert check(build_frame(range(30), 60, duration_s=0.14), trains=[train], fit="priority")[1].omitted
