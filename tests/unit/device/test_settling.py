import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.device.config import Config
from optodrive.device.gate_timing import build_servo, settling_s
from optodrive.device.settling import SettlingTable

CONFIG = DISPLAYS["display-1511"].config
MOVES = SettlingTable.from_config(CONFIG)
PITCH_RAD = 4e-3 / 0.44
LONG_US = 10_000


def modify(config, **sections):
    table = config.model_dump()
    for name, values in sections.items():
        table[name] |= values
    return Config.model_validate(table)


EXACT = {"bandwidth_uncertainty": 0.0, "damping_uncertainty": 0.0, "slew_uncertainty": 0.0, "delay_uncertainty_s": 0.0}

RINGING = modify(
    CONFIG,
    scanner={"damping": 0.3, "bandwidth_hz": 400.0, "slew_rad_per_s": 300.0},
    display={"pitch_m": 2.1e-3, "missing": []},
    laser={"pwm_hz": 50_000.0},
)
"""A ringing servo, adjacent pixels and pulses of 20 µs: the worst case of consecutive moves."""

OVERSHOOTING = modify(RINGING, scanner={"damping": 0.5})


def test_no_move_takes_no_time():
    assert MOVES.settling_us(0.0, 0.0) == 0
    assert MOVES.settling_us(1e-12, -1e-12, LONG_US) == 0


def test_the_later_axis_decides():
    one, three = MOVES.settling_us(PITCH_RAD, 0.0, LONG_US), MOVES.settling_us(0.0, 3 * PITCH_RAD, LONG_US)
    assert one < three == MOVES.settling_us(-PITCH_RAD, 3 * PITCH_RAD, LONG_US)


def test_axes_with_unlike_room_have_times_of_their_own():
    moves = SettlingTable.from_config(modify(CONFIG, display={"absorber_height_m": 1.2e-3}))
    assert moves.settling_us(PITCH_RAD, 0.0, LONG_US) == MOVES.settling_us(PITCH_RAD, 0.0, LONG_US)
    assert moves.settling_us(0.0, PITCH_RAD, LONG_US) > MOVES.settling_us(0.0, PITCH_RAD, LONG_US)


@pytest.mark.parametrize(("name", "pitch_us"), [("display-1511", 327), ("display-437", 317)])
def test_a_pitch_takes_as_long_as_the_focus_of_an_exact_servo_needs_to_be_on_the_absorber(name, pitch_us):
    config = modify(DISPLAYS[name].config, scanner=EXACT)
    moves, servo = SettlingTable.from_config(config), build_servo(config.scanner)
    exact_us = 1e6 * settling_s(servo, moves.pitch_rad, 0.99 * config.tolerance_rad[0])
    assert moves.settling_us(moves.pitch_rad, 0.0, LONG_US) == pitch_us
    assert exact_us <= pitch_us <= exact_us + 2


@pytest.mark.parametrize(
    "moves",
    [MOVES, SettlingTable.from_config(RINGING), SettlingTable.from_config(OVERSHOOTING)],
    ids=["shipped", "ringing", "overshooting"],
)
def test_times_rise_and_no_detour_is_quicker(moves):
    for table in (*moves.after_long_dwell, *moves.after_short_dwell):
        times_us = np.array(table)
        assert np.all(np.diff(times_us) >= 0)
        for far in range(2, len(times_us)):
            ways_us = times_us[1:far] + times_us[far - 1 : 0 : -1]
            assert times_us[far] <= ways_us.min()
    for long_us, short_us in zip(moves.after_long_dwell, moves.after_short_dwell, strict=True):
        assert np.all(np.array(short_us) >= np.array(long_us))
    assert moves.lead_in_us >= moves.after_short_dwell[0][-1]


@pytest.mark.parametrize(
    ("uncertainty", "pitch_us"),
    [
        ({"bandwidth_uncertainty": 0.1}, 355),
        ({"damping_uncertainty": 0.1}, 350),
        ({"slew_uncertainty": 0.1}, 333),
        ({"delay_uncertainty_s": 1e-5}, 337),
        (dict.fromkeys(EXACT, 0.1) | {"delay_uncertainty_s": 1e-5}, 397),
    ],
)
def test_each_uncertainty_of_the_servo_takes_time(uncertainty, pitch_us):
    moves = SettlingTable.from_config(modify(CONFIG, scanner=EXACT | uncertainty))
    assert moves.settling_us(moves.pitch_rad, 0.0, LONG_US) == pytest.approx(pitch_us, abs=2)


def test_without_care_a_detour_would_be_quicker():
    """Settled separately, two moves of this servo are faster than the single one that overshoots."""
    servo, tolerance_rad = build_servo(OVERSHOOTING.scanner), 0.9 * OVERSHOOTING.tolerance_rad[0]
    moves = SettlingTable.from_config(OVERSHOOTING)
    separate_us = [
        1e6 * settling_s(servo, k * moves.pitch_rad, tolerance_rad) for k in range(len(moves.after_long_dwell[0]))
    ]
    assert any(separate_us[a + b] > separate_us[a] + separate_us[b] for a in range(1, 15) for b in range(1, 15))


def test_a_move_between_whole_pitches_takes_at_least_that_of_the_next():
    assert MOVES.settling_us(1.2 * PITCH_RAD, 0.0, LONG_US) == MOVES.settling_us(2 * PITCH_RAD, 0.0, LONG_US)


def test_a_short_stay_makes_the_next_move_longer():
    assert MOVES.settling_us(PITCH_RAD, 0.0, MOVES.long_dwell_us - 1) > MOVES.settling_us(
        PITCH_RAD, 0.0, MOVES.long_dwell_us
    )


def test_a_single_pixel_needs_no_lead():
    assert DISPLAYS["display-1"].scan_head.settling.lead_in_us == 0


def test_from_the_middle_of_an_even_lattice_the_lead_is_long_enough():
    config = modify(CONFIG, display={"rows": 1, "columns": 2, "missing": []})
    servo, half_rad = build_servo(config.scanner), 0.5 * PITCH_RAD
    assert SettlingTable.from_config(config).lead_in_us >= 1e6 * settling_s(
        servo, half_rad, 0.9 * config.tolerance_rad[0]
    )
