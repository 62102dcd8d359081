"""Pattern and term as optodrive sees them: `pytest`, in an environment where both packages are installed."""

import pytest
from lab_optodrive.terms import membrane_slack_displacement

from optodrive.device.config_file import load_config
from optodrive.physics.terms import discover_terms
from optodrive.planning.stimuli.pattern_registry import build_pattern


def test_the_cross_raises_a_row_and_a_column():
    (frame,) = build_pattern("cross", {"height_um": 80}, load_config("display-16")).frames
    assert list(frame.target_m.nonzero()[0]) == [1, 4, 5, 6, 7, 9, 13]


def test_slack_takes_its_depth_from_a_high_membrane_and_all_from_a_low_one():
    assert "membrane_slack" in discover_terms()
    high, low = (membrane_slack_displacement.py_func([5e-6], None, 0, None, z) for z in (200e-6, 0.1e-6))
    assert high == pytest.approx(195e-6, rel=1e-3)
    assert low < 2e-9
