"""The paper's experiments with the daemon and the firmware core on an emulated Cortex-M3."""

import numpy as np
import pytest

import test_six_experiments as simulated
from firmware_ports import build_board
from test_six_experiments import bench, executed, test_experiment_6_two_fingers_interleaved  # noqa: F401

PULSES_MIN = 200
TRAIN = {"pixel": 200, "start_s": 0.0, "duration_s": 1.0, "pulse_width_s": 0.010, "gap_s": 0.015, "power_w": 1.0}


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    return {"program": build_board(tmp_path_factory.mktemp("cortex-m3"), port="mps2-an385")}


def test_the_pin_follows_the_log_and_is_never_early(bench):  # noqa: F811
    """The delay of the pin is a property of the emulator and depends on the load of this machine."""
    board, daemon = bench
    while len(board.of("pulse")) <= PULSES_MIN:
        plan = daemon.call("POST", "/v1/plans", json={"trains": [TRAIN]})["plan"]
        assert daemon.finished(plan)["status"] == "done"
    pulses, pins = board.of("pulse"), board.of("pin")
    assert [pin["on"] for pin in pins] == [True, False] * len(pulses)
    due_us = [at_us for pulse in pulses for at_us in (pulse["on_us"], pulse["off_us"])]
    late_us = np.array([pin["t_us"] for pin in pins]) - due_us
    print(f"pin after the log's edge: median {np.median(late_us):.0f} µs, at most {late_us.max()} µs")
    assert late_us.min() >= 0


@pytest.mark.slow
class TestTheOthers:
    """The other experiments, which every run plays on the simulated board."""

    test_experiment_1 = staticmethod(simulated.test_experiment_1_linear_motion)
    test_experiment_2 = staticmethod(simulated.test_experiment_2_rotation)
    test_experiment_3 = staticmethod(simulated.test_experiment_3_localisation)
    test_experiment_4 = staticmethod(simulated.test_experiment_4_intensity)
    test_experiment_5 = staticmethod(simulated.test_experiment_5_temporal_patterns)
