"""Doses are relative to the largest dose of any pixel."""

import numpy as np
import pytest

from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.diagnosis.dataset import build_dataset


def run(name, pixel, joules):
    t_s = np.linspace(0.0, 0.1, 50)
    pulses = np.array([[0.01, joules / 2.0, 2.0, pixel]])
    return Run(name, 295.0, pulses, {"displacement_m": Signal(pixel, t_s, 1e-6 * t_s, None)}, {})


def test_doses_of_pixels_are_comparable():
    runs = (run("a", 0, 0.05), run("b", 1, 0.02), run("c", 0, 0.05), run("d", 1, 0.02))
    scenes = [scene for scene, _ in build_dataset(Measurement(runs)).experiments]
    assert [scene.dose_before for scene in scenes] == pytest.approx([0.0, 0.0, 0.5, 0.2])
    assert [scene.dose_per_j for scene in scenes] == pytest.approx([10.0] * 4)
