"""Of clean recordings of hidden displays, with any cause, nothing is left out before any physics."""

import pytest

from blind_lab import draw_case
from optodrive.lab.inspection.inspection import inspect_recording
from optodrive.lab.recording import read_recording

EXPECTED = {"thermometer_ceiling": {"clipped"}, "missed_pulses": {"dead", "trigger"}}
"""Mechanisms that are faults of an instrument or of the light in single runs."""
FEW = [("none", 1), ("single", 12), ("unknown", 2)]
MANY = [
    (block, seed)
    for block, count in (("none", 40), ("single", 36), ("pair", 20), ("unknown", 24))
    for seed in range(count)
]


@pytest.mark.parametrize("cases", [FEW, pytest.param(MANY, marks=pytest.mark.slow)], ids=["few", "many"])
def test_nothing_of_a_clean_recording_is_left_out(tmp_path, cases):
    for block, seed in cases:
        case = draw_case(block, seed, tmp_path)
        inspection = inspect_recording(read_recording(case.path))
        allowed = {kind for cause in case.causes for kind in EXPECTED.get(cause, ())}
        assert {item.kind for item in inspection.omitted} <= allowed, (block, seed)
        assert inspection.failures == (), (block, seed)
        case.path.unlink()
