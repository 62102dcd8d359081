"""The board's settling time is below the planned one, but close to it."""

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.device.config import Config
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.session.plan_job import RETIMING_MAX_TICKS
from optodrive.link.simulator.guards import DEFAULT_LIMITS, tighten


def board_us(limits, codes):
    """Return the settling time of the board, rule B7, µs."""
    return np.where(codes > 0, limits.settle_us + -(-codes * limits.settle_ns_per_code // 1000), 0)


def list_moves(display, rng, count=400):
    """Return codes and planned times of moves after long dwell, between pixels and from the centre."""
    scale, moves = build_board_requirements(display.config).scale, display.scan_head.settling
    x_rad, y_rad = display.scan_head.field.angles_rad(display.layout.x_m, display.layout.y_m)
    pairs = rng.integers(len(display.layout), size=(count, 2))
    pairs = np.concatenate([pairs, [[k, min(k + 1, len(x_rad) - 1)] for k in range(len(x_rad))]])
    codes = [np.abs(np.diff(scale.to_codes(angle_rad)[pairs], axis=1)[:, 0]) for angle_rad in (x_rad, y_rad)]
    steps = zip(x_rad[pairs], y_rad[pairs], strict=True)
    planned = [moves.settling_us(x[1] - x[0], y[1] - y[0], moves.long_dwell_us) for x, y in steps]
    first = np.maximum(np.abs(scale.to_codes(x_rad) - 32768), np.abs(scale.to_codes(y_rad) - 32768))
    return np.append(np.maximum(*codes), first), np.append(planned, np.full(len(x_rad), moves.lead_in_us))


@pytest.mark.parametrize("name", sorted(DISPLAYS))
def test_the_boards_settling_time_is_just_below_the_planned_one(name):
    display = DISPLAYS[name]
    limits = tighten(DEFAULT_LIMITS, build_board_requirements(display.config).limits)
    codes, planned_us = list_moves(display, np.random.default_rng(1))
    assert np.all(board_us(limits, codes) <= planned_us)
    pitch = (
        build_board_requirements(display.config).scale.to_codes(np.array([display.scan_head.settling.pitch_rad]))[0]
        - 32768
    )
    moves = display.scan_head.settling
    assert board_us(limits, pitch) >= moves.settling_us(moves.pitch_rad, 0.0, moves.long_dwell_us) - 20


def test_a_single_off_centre_pixel_includes_the_move_from_the_centre():
    table = DISPLAYS["display-16"].config.model_dump()
    table["display"] |= {"rows": 2, "columns": 2, "missing": [[0, 0], [0, 1], [1, 0]]}
    display = type(DISPLAYS["display-16"]).from_config(Config.model_validate(table))
    codes, planned_us = list_moves(display, np.random.default_rng(1), 1)
    assert np.all(board_us(build_board_requirements(display.config).limits, codes) <= planned_us)


UNCERTAINTIES = ("bandwidth_uncertainty", "damping_uncertainty", "slew_uncertainty", "delay_uncertainty_s")


@pytest.mark.parametrize("servo", [{"slew_rad_per_s": 3.0, "bandwidth_hz": 2000.0}, {"slew_rad_per_s": 1.0}])
def test_a_slew_that_decides_alone_leaves_the_board_no_time_to_start_with(servo):
    table = DISPLAYS["display-16"].config.model_dump()
    table["scanner"] |= {"delay_s": 0.0, **servo} | dict.fromkeys(UNCERTAINTIES, 0.0)
    display = type(DISPLAYS["display-16"]).from_config(Config.model_validate(table))
    limits = build_board_requirements(display.config).limits
    codes, planned_us = list_moves(display, np.random.default_rng(1))
    assert np.all(board_us(limits, codes) <= planned_us)
    assert limits.settle_us == RETIMING_MAX_TICKS, "as much as a retimed point may miss"
    assert board_us(limits, codes.max()) >= 0.99 * planned_us.max()


def test_the_simulated_board_settles_fast_enough_for_every_display():
    for display in DISPLAYS.values():
        requested = build_board_requirements(display.config).limits
        assert DEFAULT_LIMITS.settle_us <= requested.settle_us
        assert DEFAULT_LIMITS.settle_ns_per_code <= requested.settle_ns_per_code
