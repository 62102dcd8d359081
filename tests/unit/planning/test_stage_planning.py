"""Plans for several optical stages over one display."""

from dataclasses import fields, replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.errors import InputError, OverBudgetError, RefusedError
from optodrive.core.types.plans import PulsePlan
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.device.config_sections import StageSection
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.limiter.limiter import build_cold_budget_state, limit
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.scheduler.stage_assignment import StageAssignment
from optodrive.planning.stimuli.experiments import build_two_fingers
from optodrive.planning.stimuli.pattern_registry import build_pattern


def build_display(name, count, **spans):
    """Build a display with equal stages.

    spans: rows or columns of each
    """
    config = DISPLAYS[name].config
    sections = {"laser": config.laser, "scanner": config.scanner, "board": config.board}
    stages = tuple(
        StageSection(name=str(k), **sections, **{key: value[k] for key, value in spans.items()}) for k in range(count)
    )
    return DisplayModel.from_config(config.model_copy(update={"stages": stages}))


@pytest.fixture(scope="module", params=[2, 3, 4])
def display(request):
    return build_display("display-437", request.param)


def plan(display, *frames, trains=(), policy="trim"):
    sequence = FrameSequence(frames, trains)
    return plan_sequence(display, sequence, *display.build_cold_state(), policy)


def full(display, height_um=50.0, show_at_s=0.0, name="f", duration_s=10.0):
    return TactileFrame(name, show_at_s, duration_s, np.full(len(display.pixels), height_um * 1e-6))


def check_beams(display, planned):
    """Assert the properties of every plan: order of starts, no overlap on a beam or a pixel, one stage per pixel."""
    result = planned.plan
    assert (np.diff(result.start_s) >= 0).all()
    for column, values in ((result.stage, range(len(display.scan_heads))), (result.pixel, range(len(display.pixels)))):
        for value in values:
            rows = column == value
            ends_s = (result.start_s + result.width_s)[rows]
            assert (result.start_s[rows][1:] >= ends_s[:-1] - 1e-9).all()
    owners = {(pixel, stage) for pixel, stage in zip(result.pixel.tolist(), result.stage.tolist(), strict=True)}
    assert len(owners) == len({pixel for pixel, _ in owners})


@pytest.mark.parametrize("heights", ["equal", "random"])
def test_stages_share_the_light_of_a_frame(display, heights):
    stages, frame = len(display.scan_heads), full(display)
    if heights == "random":
        target_m = np.random.default_rng(3).uniform(20e-6, 150e-6, len(display.pixels))
        frame = replace(frame, target_m=target_m)
    planned = plan(display, frame)
    check_beams(display, planned)
    lead_in_s, result = planned.lead_in_s, planned.plan
    assert compute_excess(display, planned) <= 1.02
    single = plan(DISPLAYS["display-437"], frame)
    assert sorted(result.pixel) == sorted(single.plan.pixel)
    order, single_order = np.argsort(result.pixel), np.argsort(single.plan.pixel)
    assert planned.predicted_m[order] == pytest.approx(single.predicted_m[single_order], rel=1e-9)
    assert result.settling_s.sum() <= 1.1 * single.plan.settling_s.sum() + stages * lead_in_s


def test_a_frame_begins_once_every_pulse_of_the_one_before_has_begun(display):
    frames = [full(display, 50.0 + 20.0 * k, 1e-3 * k, f"f{k}") for k in range(3)]
    planned = plan(display, *frames)
    check_beams(display, planned)
    assert (np.diff(planned.plan.source) >= 0).all()


def build_pages(display):
    """Build pages of braille whose dots recur unevenly."""
    text = (
        "the quick brown fox jumps over the lazy dog and reads a page of braille with two fingers on a display of light"
    )
    words = text.split()
    texts = [" ".join(words[first : first + 4]) for first in range(0, 20, 2)]
    targets_m = [
        build_pattern("text", {"text": text, "height_um": 100}, display.config).frames[0].target_m for text in texts
    ]
    return [TactileFrame(f"f{k}", 1e-3 * k, 10.0, target_m) for k, target_m in enumerate(targets_m)]


def compute_excess(display, planned):
    """Return the time of a plan over light ÷ stages + moves."""
    stages, result = len(display.scan_heads), planned.plan
    floor_s = (result.width_s.sum() + result.settling_s.sum() - stages * planned.lead_in_s) / stages
    return (result.end_s - planned.lead_in_s) / floor_s


def test_dots_that_recur_are_shared_over_the_whole_plan(display):
    planned = plan(display, *build_pages(display))
    check_beams(display, planned)
    assert compute_excess(display, planned) <= 1.035


def test_decided_frame_by_frame_recurring_dots_would_be_uneven(display, monkeypatch):
    """Mutant: the pixels that later pages light are not looked at."""
    monkeypatch.setattr(StageAssignment, "_assign_recurring", lambda *_: None)
    planned = plan(display, *build_pages(display))
    check_beams(display, planned)
    assert compute_excess(display, planned) > 1.06


def build_rotating_bar(display):
    """Build two turns of a bar from the centre to the edge."""
    layout = display.layout
    angle, radius_m = np.arctan2(layout.y_m, layout.x_m), np.hypot(layout.x_m, layout.y_m)
    turns = [np.abs(np.angle(np.exp(1j * (angle - k * np.pi / 8)))) for k in range(16)] * 2
    targets_m = [np.where((turn < 0.2) & (radius_m > display.config.display.pitch_m), 100e-6, 0.0) for turn in turns]
    return [TactileFrame(f"f{k}", 1e-3 * k, 10.0, target_m) for k, target_m in enumerate(targets_m)]


def test_frames_that_are_level_one_by_one_are_not_shared_before(display):
    """The model expects less of a share over the whole plan than it errs; frame by frame the plan corrects itself."""
    assert compute_excess(display, plan(display, *build_rotating_bar(display))) <= 1.015


def test_a_share_that_the_model_prefers_by_less_than_it_errs_would_end_later(monkeypatch):
    """Mutant: any gain counts."""
    monkeypatch.setattr("optodrive.planning.scheduler.stage_assignment.GAIN_ENOUGH", 0.0)
    display = build_display("display-437", 4)
    assert compute_excess(display, plan(display, *build_rotating_bar(display))) > 1.02


@pytest.mark.parametrize("interval_s", [1e-3, 1.0])
def test_recurring_dots_are_shared_before_with_and_without_pauses_between_frames(display, interval_s):
    pages = [replace(page, show_at_s=interval_s * k) for k, page in enumerate(build_pages(display))]
    stage_of = display.build_assignment(FrameSequence(tuple(pages))).stage_of
    is_recurring = np.sum([page.target_m > 0 for page in pages], axis=0) > 1
    assert ((stage_of >= 0) == is_recurring).all()


def test_each_stage_keeps_to_its_reach_where_dots_recur():
    display = build_display("display-437", 2, columns=((0, 14), (8, 22)))
    planned = plan(display, *build_pages(display))
    check_beams(display, planned)
    column = display.layout.column[planned.plan.pixel]
    assert (column[planned.plan.stage == 0] <= 14).all()
    assert (column[planned.plan.stage == 1] >= 8).all()


def test_two_fingers_feel_trains_at_once():
    """With one beam they exclude each other."""
    trains = tuple(PulseTrain(pixel, 0.0, 0.5, 0.02, 0.005, 1.0) for pixel in (5, 10))
    one, two = DISPLAYS["display-16"], build_display("display-16", 2)
    assert plan(one, trains=trains).train_lateness_max_s > 0.01
    planned = plan(two, trains=trains)
    check_beams(two, planned)
    assert planned.train_lateness_max_s == 0.0
    assert set(planned.plan.stage.tolist()) == {0, 1}


@pytest.mark.parametrize("digits", ["2-3", "2-5"])
def test_experiment_6_takes_the_paper_s_600_ms(digits):
    """One stage needs time for the moves between the fingers. Of two, one moves while the other draws."""
    display = build_display("display-437", 2)
    planned = plan_sequence(display, build_two_fingers(display.config, "f", digits, None), *display.build_cold_state())
    check_beams(display, planned)
    assert planned.train_lateness_max_s == 0.0
    assert planned.plan.end_s - planned.plan.start_s[0] == pytest.approx(0.6, abs=1e-6)
    assert planned.plan.width_s.sum() == pytest.approx(0.6)


def test_a_train_keeps_its_times_while_other_stages_draw_a_frame(display):
    train = PulseTrain(100, 0.0, 0.1, 0.005, 0.005, 1.0)
    target_m = np.full(len(display.pixels), 50e-6)
    target_m[100] = 0.0
    planned = plan(display, replace(full(display), target_m=target_m), trains=(train,))
    check_beams(display, planned)
    late = planned.plan.start_s - planned.plan.requested_start_s
    assert late[planned.plan.source == 1].max() < 1e-9


def test_each_stage_draws_what_it_reaches():
    display = build_display("display-16", 2, columns=((0, 1), (1, 3)))
    planned = plan(display, full(display))
    check_beams(display, planned)
    column = display.layout.column[planned.plan.pixel]
    assert (column[planned.plan.stage == 0] <= 1).all()
    assert (column[planned.plan.stage == 1] >= 1).all()
    assert len(planned.plan) == 16


def build_hot_case():
    """Return a display of two stages with a low cap, and frames that exceed it."""
    config = build_display("display-16", 2).config
    limits = config.limits.model_copy(update={"touch_max_c": config.ambient_c + 4.0})
    display = DisplayModel.from_config(config.model_copy(update={"limits": limits}))
    return display, [TactileFrame(f"f{k}", 0.3 * k, 0.3, np.full(16, 400e-6)) for k in range(12)]


def test_under_delay_nothing_is_trimmed():
    display, hot = build_hot_case()
    planned = plan(display, *hot, policy="delay")
    check_beams(display, planned)
    assert planned.delays
    assert not planned.plan.trimmed_j.any()


def test_under_refuse_a_pulse_above_a_cap_is_named():
    display, hot = build_hot_case()
    with pytest.raises(OverBudgetError, match="touch surface temperature cap"):
        plan(display, *hot, policy="refuse")


def test_an_interleaved_frame_is_shared(display):
    frame = replace(full(display, 100.0), simultaneous=True)
    target_m = np.where(np.arange(len(display.pixels)) % 40 == 0, frame.target_m, 0.0)
    planned = plan(display, replace(frame, target_m=target_m))
    check_beams(display, planned)
    assert planned.simultaneous[0].simultaneity >= planned.simultaneous[0].simultaneity_single_pulse


def test_feasibility_counts_the_light_of_all_stages():
    one, two = DISPLAYS["display-437"], build_display("display-437", 2)
    frame = full(one, duration_s=0.9)
    assert not check_feasibility(one, FrameSequence((frame,)), *one.build_cold_state())[1].fits
    assert check_feasibility(two, FrameSequence((frame,)), *two.build_cold_state())[1].fits
    late = check_feasibility(two, FrameSequence((replace(frame, duration_s=0.4),)), *two.build_cold_state())[1]
    assert (late.fits, late.proof) == (False, "bound")


def test_two_beams_on_one_pixel_are_refused():
    display = build_display("display-16", 2)
    plan_ = plan(display, full(display)).plan
    columns = {item.name: getattr(plan_, item.name)[:2].copy() for item in fields(PulsePlan)}
    columns["pixel"][:], columns["stage"][:] = 5, (0, 1)
    columns["start_s"][:] = 0.01, 0.011
    columns["width_s"][:] = 0.005
    with pytest.raises(RefusedError, match="starts before"):
        limit(PulsePlan(**columns), build_cold_budget_state(16, stage_count=2), display.budget)


def test_a_model_that_couples_pixels_needs_one_stage(tmp_path):
    config = build_display("display-16", 2).config
    (tmp_path / "model.toml").write_text(
        'format = "optodrive-parameters"\nversion = 1\nbase = "calibrated"\nplanner_terms = ["gas_leak"]\n'
        '[terms.gas_leak]\nrate = { value = 1.0, unit = "1/s", source = "here" }\n'
    )
    section = config.pixel_model.model_copy(update={"parameters": str(tmp_path / "model.toml")})
    with pytest.raises(InputError, match=r"pixel_model.parameters: .* one stage"):
        DisplayModel.from_config(config.model_copy(update={"pixel_model": section}))
