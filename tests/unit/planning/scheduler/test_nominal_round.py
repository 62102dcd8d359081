"""A frame's round in one kernel against the same round pulse by pulse."""

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.planning.scheduler.scheduler import GalvoPause, Scheduler
from optodrive.planning.scheduler.stage_assignment import PulseWidthEstimate, StageAssignment


class PulseByPulse:
    """Heat that the scheduler does not take for nominal pixels."""

    def __init__(self, heat):
        self._heat = heat

    def __getattr__(self, name):
        return getattr(self._heat, name)

    def copy(self):
        return PulseByPulse(self._heat.copy())


def plan_batches(display, frames, heat, initial_pixel, pause_count, stage_count):
    """Return the batches of a scheduler, the first ones with pauses, and the pulses that it skipped."""
    sequence, scan_heads = FrameSequence(frames), display.scan_heads * stage_count
    reach = np.ones((stage_count, len(display.pixels)), dtype=bool)
    pulse_widths = PulseWidthEstimate.from_cold(
        display.build_cold_heat(), display.max_displacement_m, display.scan_head.drive
    )
    assignment = StageAssignment(sequence, scan_heads, reach, pulse_widths)
    initial_pixels = None if initial_pixel is None else (initial_pixel,) * stage_count
    scheduler = Scheduler(scan_heads, assignment, sequence, display.build_cold_heat, initial_pixels=initial_pixels)
    batches, pauses = [], []

    def grant(batch):
        if len(pauses) < pause_count:
            pauses.append(GalvoPause(len(batch) * (len(pauses) + 1) // 4, len(pauses) % stage_count, 1234))
            scheduler.pause(pauses[-1])
            return None
        batches.append(batch)
        return batch

    list(scheduler.run(heat, grant))
    return batches, sorted(scheduler.skipped, key=lambda each: (each.source, each.pixel)), scheduler._state


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.sampled_from([1, 2, 30, 400]),
    initial_pixel=st.sampled_from([None, 0, 200]),
    pause_count=st.integers(0, 3),
    stage_count=st.integers(1, 4),
)
def test_the_kernel_plans_what_the_loop_plans(display, seed, count, initial_pixel, pause_count, stage_count):
    rng = np.random.default_rng(seed)
    frames = []
    for number in range(2):  # the second frame meets warm pixels, of which some need no pulse
        target_m = np.zeros(len(display.layout))
        target_m[rng.choice(len(display.layout), count, replace=False)] = rng.uniform(1e-6, 2e-4, count)
        frames.append(TactileFrame("f", 0.02 * number, 0.5, target_m))
    by_kernel, by_loop = (
        plan_batches(display, tuple(frames), heat, initial_pixel, pause_count, stage_count)
        for heat in (display.build_cold_heat(), PulseByPulse(display.build_cold_heat()))
    )
    assert by_kernel[1:] == by_loop[1:]
    assert len(by_kernel[0]) == len(by_loop[0])
    for kernel_batch, loop_batch in zip(by_kernel[0], by_loop[0], strict=True):
        for name in vars(loop_batch):
            np.testing.assert_array_equal(getattr(kernel_batch, name), getattr(loop_batch, name), name)
