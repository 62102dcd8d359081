"""Feasibility check with its violations, proofs, nearest feasible variants and refusals."""

import json
from dataclasses import replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError, OverBudgetError, RefusedError
from optodrive.core.types.stimuli import FrameSequence, HeightTrain, PulseTrain, TactileFrame
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility import order_search
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.feasibility.reduction import omit_pixels, scale_sequence, stretch_sequence
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


def test_a_feasible_sequence_costs_one_plan():
    planned, report = check(build_frame(range(20)))
    assert report.fits
    assert report.proof == "planned"
    assert report.plans_tried == 0
    assert 0 < report.beam_required_s < report.beam_available_s == pytest.approx(1.0)
    alone = plan_sequence(DISPLAY, planned.sequence, *DISPLAY.build_cold_state())
    assert np.array_equal(planned.plan.start_s, alone.plan.start_s)


def test_a_late_frame_is_reported_with_its_beam_time_and_the_nearest_feasible():
    planned, report = check(LATE_FRAME)
    assert not report.fits
    assert (report.proof, report.reason, report.name) == ("bound", "deadline", "f")
    assert report.beam_required_s == pytest.approx(0.1 + planned.frames[0].late_s)
    assert report.beam_available_s == pytest.approx(0.1)
    assert 0.1 < report.beam_lower_bound_s <= report.beam_required_s
    assert report.plans_tried <= report.plans_tried_max
    nearest = report.nearest
    assert nearest.complete
    assert nearest.pixels.kept + len(nearest.pixels.omitted[0].pixels) == nearest.pixels.requested == 40
    assert nearest.time_factor == pytest.approx(report.beam_required_s / 0.1, rel=0.02)
    for word in ("needs", "takes at least", f"{nearest.pixels.kept} of 40 pixels", f"× {nearest.height_factor:g}"):
        assert word in report.message
    assert json.loads(json.dumps(report.to_dict()))["nearest"]["time_factor"] == nearest.time_factor


def test_a_frame_near_its_deadline_is_searched_exhaustively():
    first = build_frame([0, 1, 2], 100, duration_s=0.02)
    _, report = check(first, replace(first, frame_id="again", show_at_s=0.02, duration_s=0.003))
    assert (report.fits, report.proof, report.name) == (False, "searched", "again")
    assert report.plans_tried > 6


def test_an_inconclusive_search_proves_nothing():
    """The second frame's pixels have been driven: their thermal state is not bounded, and the orders are too many."""
    first = build_frame(range(30), 60, 0.0, 0.2, "a")
    _, report = check(first, build_frame(range(30), 60, 0.2, 0.09, "b"))
    assert (report.fits, report.proof, report.name) == (False, "not found", "b")
    assert "does not prove" in report.message
    assert report.beam_required_s > report.beam_available_s


def test_there_is_no_lower_bound_with_planner_terms():
    terms = replace(DISPLAY, parameters=DISPLAY.parameters.model_copy(update={"planner_terms": ("droop",)}))
    given = FrameSequence((LATE_FRAME,)), DISPLAY.build_cold_heat(), 0, 0.002
    assert beam_lower_bound_s(terms, *given) is None
    assert beam_lower_bound_s(DISPLAY, *given) > 0.1


def test_the_lower_bound_excludes_pixels_driven_before():
    given = DISPLAY.build_cold_heat(), 1, 0.002
    alone = beam_lower_bound_s(
        DISPLAY, FrameSequence((build_frame([5], name="a"), build_frame([6, 7], show_at_s=1.0))), *given
    )
    shared = beam_lower_bound_s(
        DISPLAY, FrameSequence((build_frame([6], name="a"), build_frame([6, 7], show_at_s=1.0))), *given
    )
    with_train = FrameSequence(
        (build_frame([5]), build_frame([6, 7], show_at_s=1.0)), (PulseTrain(6, 0, 0.1, 0.01, 0.01, 1.0),)
    )
    assert shared < 0.6 * alone
    assert beam_lower_bound_s(DISPLAY, with_train, *given) == pytest.approx(shared)


def test_a_violated_cap_is_named():
    planned, report = check(*HOT_FRAMES, display=with_caps(touch_k=2.0))
    assert not report.fits
    assert report.reason == "touch_temperature"
    assert report.pixel == planned.shortfall.pixel
    assert "touch surface temperature cap" in report.message
    assert 0 < report.nearest.height_factor < 1 < report.nearest.time_factor


def test_a_refusal_carries_the_report():
    with pytest.raises(RefusedError, match="nearest feasible") as late:
        check(LATE_FRAME, policy="refuse")
    assert late.value.code == "refused"
    assert late.value.feasibility["name"] == "f"


def test_delay_waits_and_reports_infeasibility():
    planned, report = check(*HOT_FRAMES, display=with_caps(touch_k=2.0), policy="delay")
    assert planned.delays
    assert not planned.plan.trimmed_j.any()
    assert report.reason == "touch_temperature"
    with pytest.raises(OverBudgetError) as never:
        check(HOT_FRAMES[0], display=with_caps(absorber_k=60.0), policy="delay")
    assert never.value.feasibility["reason"] == "absorber_temperature"


@pytest.mark.parametrize("fit", ["even", "priority"])
def test_best_effort_passes_every_policy(fit):
    planned, report = check(LATE_FRAME, fit=fit, policy="refuse")
    assert not report.fits
    assert (report.height_factor < 1) == (fit == "even")
    assert bool(report.omitted) == (fit == "priority")
    assert not planned.plan.trimmed_j.any()
    assert all(timing.late_s == 0 for timing in planned.frames)


def test_an_unreachable_target_is_refused_as_is_and_changed_on_request():
    with pytest.raises(InputError, match="target_um of pixel 3"):
        check(build_frame([3], 5000))
    _, lower = check(build_frame([3, 4], [1000, 100]), fit="even")
    assert lower.reason == "unreachable"
    assert lower.height_factor == pytest.approx(0.5, abs=0.02)
    planned, fewer = check(build_frame([3, 4], [1000, 100]), fit="priority")
    assert [(item.name, item.pixels) for item in fewer.omitted] == [("f", (3,))]
    assert planned.plan.pixel.tolist() == [4]
    with pytest.raises(RefusedError, match="no part of it fits"):
        check(build_frame([3], 1000), fit="priority")


def test_the_source_of_higher_priority_stays():
    """A train leaves a frame no beam time. The one of lower priority is omitted."""
    train = PulseTrain(9, 0.0, 0.1, 0.02, 0.005, 0.3)
    _, first = check(build_frame([0, 1], 200, duration_s=0.05, priority=1), trains=[train], fit="priority")
    assert [(item.name, item.pixels) for item in first.omitted] == [("train 0", (9,))]
    _, second = check(build_frame([0, 1], 200, duration_s=0.05), trains=[replace(train, priority=1)], fit="priority")
    assert [(item.name, item.pixels) for item in second.omitted] == [("f", (0, 1))]


def test_a_large_frame_loses_few_pixels():
    target_um = np.linspace(20, 120, 60)
    _, report = check(build_frame(range(60), target_um, duration_s=0.22), fit="priority")
    (left,) = report.omitted
    assert max(left.pixels) == 59
    assert len(left.pixels) < 20


def test_an_exhausted_search_tries_no_more_sequences(monkeypatch):
    """A try without a plan reports no progress, and the lease would expire during many of them."""
    tried = []
    true = order_search.OrderSearch.find_orders
    monkeypatch.setattr(
        order_search.OrderSearch, "find_orders", lambda self, sequence: tried.append(1) or true(self, sequence)
    )
    monkeypatch.setattr("optodrive.planning.feasibility.check.PULSES_REQUESTED_MAX", 0)
    frames = [build_frame(range(40), 60, 0.11 * k, 0.11, f"f{k}") for k in range(50)]
    _, report = check(*frames, fit="priority")
    assert not report.nearest.complete
    assert sum(len(item.pixels) for item in report.omitted) > 200
    assert len(tried) < 80


def test_trains_whose_settling_times_add_up_do_not_fit():
    trains = [PulseTrain(200 + k, 0.015 * k, 0.015, 0.015, 0.015, 1.0) for k in range(3)]
    assert check(trains=trains[:2])[1].fits
    _, report = check(trains=trains)
    assert (report.fits, report.proof, report.name) == (False, "bound", "train 2")
    assert report.beam_required_s > report.beam_available_s > 0.015
    assert report.nearest.height_factor is None
    with pytest.raises(RefusedError, match="no height fits"):
        check(trains=trains, fit="even")
    slower = stretch_sequence(build_pattern("experiment-6", {}, DISPLAY.config), 1.06)
    assert check_feasibility(DISPLAY, slower, *DISPLAY.build_cold_state())[1].fits


def test_progress_is_shown_while_orders_are_searched():
    progress = []
    frames = [build_frame(range(4 * k, 4 * k + 4), 100, 0.05 * k, 0.05 if k < 1 else 0.0245, f"f{k}") for k in range(2)]
    _, report = check(*frames, trains=[PulseTrain(9, 0.0501, 0.02, 0.0004, 0.003, 0.3)], on_progress=progress.append)
    assert report.plans_tried > 20
    assert len(progress) > report.plans_tried


def test_a_search_ends_at_its_limit_and_proves_nothing(monkeypatch):
    monkeypatch.setattr("optodrive.planning.feasibility.check.ORDERS_MAX", 5)
    monkeypatch.setattr("optodrive.planning.feasibility.check.count_orders", lambda *_: 1)
    monkeypatch.setattr(order_search, "beam_lower_bound_s", lambda *given: None)
    _, report = check(build_frame(range(4), 100, duration_s=0.02))
    assert (report.fits, report.proof) == (False, "not found")


def test_variants_keep_all_other_fields():
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


def test_height_trains_are_scaled_and_stretched():
    train = HeightTrain(3, 0.1, 0.4, 0.04, 300e-6, 100e-6, priority=2)
    sequence = FrameSequence((), (train,))
    assert scale_sequence(sequence, 0.5).trains == (replace(train, target_m=150e-6, peak_to_peak_m=50e-6),)
    assert stretch_sequence(sequence, 2.0).trains == (replace(train, start_s=0.2, duration_s=0.8, period_s=0.08),)


def test_a_height_train_takes_beam_time_from_a_frame():
    """Both do not fit at full height. The scaled variant fits, although the train has other cycles then."""
    train = HeightTrain(9, 0.0, 0.5, 0.025, 250e-6, 60e-6)
    _, alone = check(build_frame(range(30), 60, duration_s=0.14))
    assert alone.fits
    _, report = check(build_frame(range(30), 60, duration_s=0.14), trains=[train])
    assert (report.fits, report.name) == (False, "f")
    assert report.nearest.height_factor is not None
    lower = scale_sequence(
        FrameSequence((build_frame(range(30), 60, duration_s=0.14),), (train,)), report.nearest.height_factor
    )
    assert check_feasibility(DISPLAY, lower, *DISPLAY.build_cold_state())[1].fits
    assert check(build_frame(range(30), 60, duration_s=0.14), trains=[train], fit="priority")[1].omitted


def test_no_height_factor_makes_a_train_weaker_than_its_laser_emits():
    """Dark, it would fit."""
    train = PulseTrain(5, 0.0, 2.0, 0.04, 0.002, 2.45)
    table = DISPLAYS["display-16"].config.model_dump()
    factors = {}
    for threshold_w in (0.0, 1.2, 2.4):
        config = type(DISPLAY.config).model_validate(table | {"laser": table["laser"] | {"threshold_w": threshold_w}})
        display = DisplayModel.from_config(config)
        _, report = check_feasibility(display, FrameSequence(trains=(train,)), *display.build_cold_state())
        assert not report.fits
        factors[threshold_w] = report.nearest.height_factor
    assert 0.0 < factors[0.0] < 1.2 / 2.45
    assert factors[1.2] is factors[2.4] is None
