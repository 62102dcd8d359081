"""The table of caps against everything that derives from it or must name every cap."""

from pathlib import Path

import pytest

from displays import DISPLAYS
from optodrive.device.config_sections import LimitsSection
from optodrive.planning.effective_config import build_effective_config
from optodrive.planning.limiter import cap_checks
from optodrive.planning.limiter.caps import CAP_NUMBERS, CAPS, REASONS, WRONG_ORDER, CapScale, CapValues

DISPLAY = DISPLAYS["display-16"]
LIMITS_PAGE = next(Path(__file__).parents[4].glob("docs/**/limits.md"))


def test_every_cap_has_a_setting_and_a_kernel_value():
    for cap in CAPS:
        assert cap.setting in LimitsSection.model_fields
        assert cap.field in CapValues._fields


def test_numbers_are_those_of_the_reasons():
    assert [REASONS[number] for number in CAP_NUMBERS.values()] == [cap.key for cap in CAPS]
    assert REASONS[0] == ""
    assert REASONS[WRONG_ORDER] == "order"
    constants = {value for name, value in vars(cap_checks).items() if name.lower() in CAP_NUMBERS}
    assert constants == set(CAP_NUMBERS.values())


def test_values_come_from_the_settings():
    limits, caps = DISPLAY.config.limits, DISPLAY.budget.caps
    assert caps.touch_k == pytest.approx(limits.touch_max_c - DISPLAY.config.ambient_c)
    assert caps.galvo_rad2_per_s4 == limits.galvo_acceleration_rms_max_rad_per_s2**2
    assert caps.pulse_energy_j == limits.pulse_energy_max_j


@pytest.mark.parametrize("scale", CapScale)
def test_a_value_is_shown_in_the_unit_of_its_setting(scale):
    setting = 43.0
    limit = scale.to_value(setting, 20.0)
    assert scale.to_setting(limit, limit, setting) == pytest.approx(setting)
    assert scale.to_setting(0.0, limit, setting) == (20.0 if scale is CapScale.TEMPERATURE else 0.0)


def test_the_effective_configuration_and_the_manual_name_every_cap():
    described = build_effective_config(DISPLAY).limits.caps
    manual = LIMITS_PAGE.read_text(encoding="utf-8")
    assert list(described) == [cap.key for cap in CAPS]
    for cap in CAPS:
        assert f"`{cap.key}`" in manual
        assert f"`{cap.setting}`" in manual
