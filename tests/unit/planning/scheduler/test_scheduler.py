import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.daemon.engine.plan_making import dim_display
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.scheduler import visiting_path
from optodrive.planning.scheduler.scheduler import GalvoPause, Scheduler


def frame(display, heights_um, show_at=0.0, duration=1.0, name="f"):
    target = np.zeros(len(display.layout))
    for pixel, height in heights_um.items():
        target[pixel] = height * 1e-6
    return TactileFrame(name, show_at, duration, target)


def plan_frames(display, *frames, trains=()):
    return plan_sequence(display, FrameSequence(tuple(frames), tuple(trains)), *display.build_cold_state())


def gaps(plan):
    return plan.start_s[1:] - (plan.start_s + plan.width_s)[:-1]


def test_every_move_has_its_settling_time(any_display):
    result = plan_frames(any_display, frame(any_display, dict.fromkeys(range(len(any_display.layout)), 40), duration=9))
    plan = result.plan
    moves = any_display.scan_head.settling
    dwell_us = np.rint(plan.width_s[:-1] * 1e6)
    steps = zip(np.diff(plan.x_rad), np.diff(plan.y_rad), dwell_us, strict=True)
    needed = [moves.settling_us(*step) * 1e-6 for step in steps]
    assert np.all(gaps(plan) >= np.array(needed) - 1e-9)
    assert len(plan) == len(any_display.layout)


def test_times_are_whole_microseconds_and_widths_whole_pwm_periods(display):
    plan = plan_frames(display, frame(display, {3: 77.7, 99: 12.3, 400: 311})).plan
    assert np.allclose(plan.start_s * 1e6, np.round(plan.start_s * 1e6), atol=1e-6)
    assert np.allclose(plan.width_s / 2e-4, np.round(plan.width_s / 2e-4), atol=1e-9)


def build_fine(display):
    """Return a display whose laser is gated in microseconds at full power."""
    laser = display.config.laser.model_copy(update={"whole_periods": False})
    return DisplayModel.from_config(display.config.model_copy(update={"laser": laser}))


def test_widths_at_full_power_are_whole_microseconds_where_the_gate_allows_it(display):
    fine = build_fine(display)
    planned = plan_frames(fine, frame(fine, {3: 77.7, 99: 12.3, 200: 1.0, 400: 311}))
    plan = planned.plan
    for times_s in (plan.start_s, plan.width_s):
        assert np.allclose(times_s * 1e6, np.round(times_s * 1e6), atol=1e-6)
    is_full = plan.power_w == display.config.laser.max_power_w
    assert is_full.tolist() == [pixel != 200 for pixel in plan.pixel.tolist()]
    assert plan.width_s[~is_full] == pytest.approx(2e-4)
    assert planned.predicted_m == pytest.approx(plan.target_m, rel=1e-3)
    dimmed = plan_frames(dim_display(fine, 0.5), frame(fine, {3: 77.7, 400: 311})).plan
    assert np.allclose(dimmed.width_s / 2e-4, np.round(dimmed.width_s / 2e-4), atol=1e-9)


@pytest.mark.parametrize("name", ["display-437", "display-1511"])
@pytest.mark.parametrize(("height_um", "rate_min_hz"), [(50.0, 328.0), (20.0, 690.0)])
def test_gates_in_microseconds_draw_a_full_frame_faster(name, height_um, rate_min_hz):
    display = DISPLAYS[name]
    fine, heights_um = build_fine(display), dict.fromkeys(range(len(display.layout)), height_um)
    planned = plan_frames(fine, frame(fine, heights_um, duration=10.0))
    assert len(planned.plan) / planned.duration_s >= rate_min_hz
    of_whole = plan_frames(display, frame(display, heights_um, duration=10.0))
    assert planned.duration_s < 0.96 * of_whole.duration_s


def test_a_long_frame_along_one_mirror_waits_for_its_coil(monkeypatch):
    """Mutant: a full frame is always a serpentine."""
    monkeypatch.setattr(visiting_path, "LONG_FRAME", 10_000)
    with pytest.raises(AssertionError):
        test_gates_in_microseconds_draw_a_full_frame_faster("display-1511", 20.0, 690.0)


def test_a_train_keeps_its_times_and_a_frame_fills_the_gaps(display):
    train = PulseTrain(200, 0.0, 0.4, 0.020, 0.030, 1.0)
    result = plan_frames(display, frame(display, dict.fromkeys(range(20), 100), duration=0.4), trains=[train])
    of_train = result.plan.source == 1
    assert of_train.sum() == 8
    assert result.train_lateness_max_s < 1e-9
    assert np.allclose(np.diff(result.plan.start_s[of_train]), 0.05)
    assert (~of_train).sum() == 20


def test_abutting_trains_are_delayed_by_settling_times_only(display):
    trains = [PulseTrain(200 + k, 0.015 * k, 0.06, 0.015, 0.045, 2.45) for k in range(4)]
    result = plan_frames(display, trains=trains)
    plan = result.plan
    assert np.allclose(gaps(plan), plan.settling_s[1:])
    assert result.train_lateness_max_s == pytest.approx(plan.settling_s[1:].sum(), abs=1e-9)


def test_a_late_frame_reports_its_delay(display):
    result = plan_frames(display, frame(display, dict.fromkeys(range(100), 100), duration=0.1))
    timing = result.frames[0]
    assert timing.late_s == pytest.approx(timing.end_s - timing.deadline_s)
    assert 0 < timing.on_time < timing.pulses == 100


def test_residual_heat_is_used(display):
    first, second = frame(display, {7: 200}, 0.0, 0.03, "a"), frame(display, {7: 200}, 0.03, 0.03, "b")
    plan = plan_frames(display, first, second).plan
    assert plan.energy_j[1] < 0.9 * plan.energy_j[0]


def test_a_pixel_still_above_its_target_is_skipped_and_named(display):
    first, second = frame(display, {7: 300}, 0.0, 0.04, "a"), frame(display, {7: 20, 8: 20}, 0.04, 0.04, "b")
    result = plan_frames(display, first, second)
    assert [(item.source, item.pixel) for item in result.skipped] == [(1, 7)]
    assert result.plan.pixel.tolist() == [7, 8]


def test_an_empty_frame_has_no_pulse(display):
    assert len(plan_frames(display, frame(display, {})).plan) == 0


def test_the_lead_in_suffices_for_a_move_from_any_pixel(any_display):
    layout, field, moves = any_display.layout, any_display.scan_head.field, any_display.scan_head.settling
    last = len(layout) - 1
    result = plan_frames(any_display, frame(any_display, {last: 40}))
    x_rad, y_rad = field.angles_rad(layout.x_m, layout.y_m)
    longest = max(moves.settling_us(x_rad[last] - x, y_rad[last] - y) for x, y in zip(x_rad, y_rad, strict=True))
    assert result.plan.start_s[0] >= longest * 1e-6 - 1e-12
    assert result.lead_in_s == pytest.approx(result.plan.start_s[0])


def test_a_given_visiting_order_is_kept(display):
    sequence = FrameSequence((frame(display, dict.fromkeys((3, 4, 5), 50)),))
    result = plan_sequence(display, sequence, *display.build_cold_state(), visiting_orders={0: np.array([4, 3, 5])})
    assert result.plan.pixel.tolist() == [4, 3, 5]


def cold(display):
    return display.build_cold_heat()


def start(display, *frames):
    sequence = FrameSequence(frames)
    return Scheduler(display.scan_heads, display.build_assignment(sequence), sequence, display.build_cold_heat)


def test_a_delayed_batch_and_everything_after_it_start_later(display):
    scheduler, heat = (
        start(display, frame(display, {3: 50, 4: 50}, 0.0, 0.1), frame(display, {9: 50}, 0.1)),
        cold(display),
    )
    first = scheduler.next_batch(heat)
    scheduler.delay(20_000)
    delayed = scheduler.next_batch(heat)
    scheduler.accept()
    second = scheduler.next_batch(heat)
    assert delayed.start_s == pytest.approx(first.start_s + 0.02)
    assert second.start_s[0] == pytest.approx(scheduler.lead_in_us * 1e-6 + 0.1 + 0.02)


def test_a_pause_follows_the_first_pulses_of_a_batch(display):
    scheduler, heat = start(display, frame(display, {3: 50, 4: 50, 5: 50})), cold(display)
    whole = scheduler.next_batch(heat)
    scheduler.pause(GalvoPause(2, 0, 100_000))
    paused = scheduler.next_batch(heat)
    assert paused.start_s == pytest.approx(whole.start_s + np.array([0.0, 0.0, 0.1]))
    scheduler.pause(GalvoPause(2, 0, 50_000))
    again = scheduler.next_batch(heat)
    assert again.start_s == pytest.approx(paused.start_s + np.array([0.0, 0.0, 0.05]))
    scheduler.accept()
    assert scheduler.next_batch(heat) is None


def test_a_pause_before_the_first_pulse_delays_the_batch(display):
    scheduler, heat = start(display, frame(display, {3: 50, 4: 50})), cold(display)
    whole = scheduler.next_batch(heat)
    scheduler.pause(GalvoPause(0, 0, 50_000))
    assert scheduler.next_batch(heat).start_s == pytest.approx(whole.start_s + 0.05)


def test_a_delayed_batch_is_planned_without_its_pauses(display):
    scheduler, heat = start(display, frame(display, {3: 50, 4: 50})), cold(display)
    whole = scheduler.next_batch(heat)
    scheduler.pause(GalvoPause(1, 0, 50_000))
    scheduler.next_batch(heat)
    scheduler.delay(20_000)
    assert scheduler.next_batch(heat).start_s == pytest.approx(whole.start_s + 0.02)


def test_a_withdrawn_batch_leaves_no_trace(display):
    frames = frame(display, {7: 300}, 0.0, 0.04, "a"), frame(display, {7: 20, 8: 20}, 0.04, 0.04, "b")
    scheduler, heat = start(display, *frames), cold(display)
    for _ in scheduler.run(heat, refuse_once(scheduler)):
        pass
    assert [(item.source, item.pixel) for item in scheduler.skipped] == [(1, 7)]


def refuse_once(scheduler):
    """Return a callback that delays every batch once by 1 µs."""
    seen = []

    def grant(batch):
        if len(seen) % 2 == 0:
            scheduler.delay(1)
        seen.append(batch)
        return batch if len(seen) % 2 == 0 else None

    return grant


def test_an_answer_needs_a_proposed_batch(display):
    scheduler, heat = start(display, frame(display, {3: 50})), cold(display)
    with pytest.raises(RuntimeError, match="no batch is proposed"):
        scheduler.accept()
    scheduler.next_batch(heat)
    scheduler.accept()
    assert scheduler.next_batch(heat) is None
    with pytest.raises(RuntimeError, match="no batch is proposed"):
        scheduler.delay(1)
