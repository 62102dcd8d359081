"""The simulated board is the one that would be built for the configured display."""

import pytest

from displays import DISPLAYS
from optodrive.core.clock import MonotonicClock
from optodrive.device.config import Config
from optodrive.link.board_setup import build_board_requirements, build_port_settings
from optodrive.link.session.session import BoardSession
from optodrive.link.transport.registry import find_transport_factory

CHANGES = (
    {"laser": {"max_power_w": 1.2}},
    {"board": {"lease_s": 0.7}},
    {"limits": {"pulse_width_max_s": 0.06, "pulse_energy_max_j": 0.18, "pixel_mean_power_max_w": 1.5}},
)


@pytest.mark.parametrize("changes", CHANGES, ids=lambda changes: next(iter(changes)))
def test_a_display_of_other_settings_connects(changes):
    table = DISPLAYS["display-16"].config.model_dump()
    for section, values in changes.items():
        table[section] |= values
    config = Config.model_validate(table)
    requirements = build_board_requirements(config)
    session = BoardSession(find_transport_factory(build_port_settings(config))(), MonotonicClock(), requirements)
    try:
        session.connect()
        assert session.board.state == "DISARMED"
    finally:
        session.close()
