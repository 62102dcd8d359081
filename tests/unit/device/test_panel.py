"""Estimates of the values that a configuration does not state of its panel."""

import pytest

from displays import DISPLAYS
from optodrive.device.config_sections import PanelSection
from optodrive.device.panel import complete_panel

CONFIG = DISPLAYS["display-1511"].config


def complete(**values):
    return complete_panel(CONFIG.model_copy(update={"panel": PanelSection(**values)}))


def test_a_panel_without_values_is_the_pixels_with_a_rim_in_still_air():
    panel = complete()
    assert panel[:2] == pytest.approx((0.176, 0.176))
    assert panel.resistance_k_per_w == pytest.approx(1.61, rel=0.01)
    assert panel.capacity_j_per_k == pytest.approx(115, rel=0.01)


def test_a_larger_panel_loses_and_holds_more_heat():
    small, large = complete(), complete(width_m=0.352)
    assert large.resistance_k_per_w == pytest.approx(0.5 * small.resistance_k_per_w)
    assert large.capacity_j_per_k == pytest.approx(2.0 * small.capacity_j_per_k)


def test_measured_values_replace_the_estimates():
    panel = complete(resistance_k_per_w=3.0, capacity_j_per_k=200.0)
    assert panel[2:] == (3.0, 200.0)
