"""The paper's six experiments with the daemon and the firmware core on an emulated Cortex-M3."""

import numpy as np
import pytest

from firmware_ports import build_board
from test_six_experiments import *  # noqa: F403


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    return {"program": build_board(tmp_path_factory.mktemp("cortex-m3"), port="mps2-an385")}


def test_the_pin_follows_the_log_and_is_never_early(bench):
    """The delay of the pin is a property of the emulator and depends on the load of this machine."""
    board, _ = bench
    pulses, pins = board.of("pulse"), board.of("pin")
    assert len(pulses) > 200
    assert [pin["on"] for pin in pins] == [True, False] * len(pulses)
    due_us = [at_us for pulse in pulses for at_us in (pulse["on_us"], pulse["off_us"])]
    late_us = np.array([pin["t_us"] for pin in pins]) - due_us
    print(f"pin after the log's edge: median {np.median(late_us):.0f} µs, at most {late_us.max()} µs")
    assert late_us.min() >= 0
