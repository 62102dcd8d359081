import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.device.config import Config
from optodrive.link.simulator.simulated_optics import INSTRUMENT_SIGMA, measure
from optodrive.link.simulator.true_display import compute_traces
from optodrive.link.simulator.virtual_run import execute
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence

OWN = {
    "display": {"rows": 6, "columns": 6, "pitch_m": 2.5e-3},
    "laser": {"max_power_w": 1.2, "pwm_hz": 2000.0},
    "scanner": {"focal_length_m": 0.4, "bandwidth_hz": 900.0, "damping": 0.5, "slew_rad_per_s": 40.0},
    "limits": {"pixel_mean_power_max_w": 0.2},
    "board": {"lease_s": 0.3},
}
"""A display whose neighbours are 586 codes apart, as no other test has it."""


def build_own_display():
    table = DISPLAYS["display-16"].config.model_dump()
    for section, values in OWN.items():
        table[section] |= values
    return DisplayModel.from_config(Config.model_validate(table))


def sequence(display, count=30, height_m=50e-6):
    target = np.zeros(len(display.layout))
    target[:count] = height_m
    return FrameSequence((TactileFrame("a", 0.0, 0.5, target), TactileFrame("b", 0.9, 0.5, target * 1.2)))


def test_what_is_planned_is_executed_on_every_display(any_display):
    prepared = plan_sequence(any_display, sequence(any_display), *any_display.build_cold_state())
    executed = execute(any_display, prepared)
    plan = prepared.plan
    assert executed.complete
    assert executed.start_s == pytest.approx(plan.start_s, abs=1e-9)
    assert executed.width_s == pytest.approx(plan.width_s, abs=1e-12)
    assert executed.power_w == pytest.approx(plan.power_w, rel=1e-3)
    assert executed.pixel.tolist() == plan.pixel.tolist()


def test_a_display_of_one_s_own_is_executed():
    """Neighbours take turns without a rest, each near its caps: none may count on the account of another."""
    display = build_own_display()
    trains = tuple(PulseTrain(pixel, 0.1 * turn, 0.09, 0.04, 0.005, 1.2) for turn, pixel in enumerate((0, 1, 7, 6)))
    prepared = plan_sequence(display, FrameSequence((), trains), *display.build_cold_state())
    assert prepared.plan.power_w.tolist() == [1.2] * 8, "nothing trimmed"
    assert execute(display, prepared).complete


@pytest.mark.parametrize(
    ("width_s", "gap_s"), [(0.05, 0.0), (0.04, 0.01), (0.025, 0.025), (0.001, 0.001), (0.0002, 0.05)]
)
def test_what_the_limiter_passes_is_no_fault_on_the_board(any_display, width_s, gap_s):
    train = PulseTrain(0, 0.0, 1.5, width_s, gap_s, any_display.config.laser.max_power_w)
    prepared = plan_sequence(any_display, FrameSequence((), (train,)), *any_display.build_cold_state())
    assert execute(any_display, prepared).complete


def test_instruments_read_the_trace_with_their_stated_noise(display):
    prepared = plan_sequence(display, sequence(display, 3), *display.build_cold_state())
    executed = execute(display, prepared)
    traced = compute_traces(display.build_cold_heat(), executed, [0, 2], 1e-3)
    pulses = np.zeros((1, 4))
    exact = measure(traced, pulses, 293.15, 4e-4, 0.0, 0)
    assert [run.name for run in exact.runs] == ["pixel-0", "pixel-2"]
    displacement = exact.runs[0].signals["displacement_m"]
    assert displacement.sigma is None
    assert displacement.value.max() == pytest.approx(60e-6, rel=0.01)
    noisy = measure(traced, pulses, 293.15, 4e-4, 2.0, 0).runs[0].signals["displacement_m"]
    assert noisy.sigma == 2 * INSTRUMENT_SIGMA["displacement_m"]
    assert np.std(noisy.value - displacement.value) == pytest.approx(noisy.sigma, rel=0.15)
    again = measure(traced, pulses, 293.15, 4e-4, 2.0, 0).runs[0].signals["displacement_m"]
    assert np.array_equal(noisy.value, again.value)
