"""`optodrive doctor` on the mirrors: a servo that nobody measured is a warning, with what measuring it can gain."""

import re

import pytest

from optodrive.cli.doctor_host import MEASURED, check_mirrors
from optodrive.device.config_file import load_config
from optodrive.lab.servo_identification.gate import HALF_WIDTH_MIN
from optodrive.planning.display_model import DisplayModel


def with_board(config, **board):
    return config.model_copy(update={"board": config.board.model_copy(update=board)})


def with_scanner(config, **scanner):
    return config.model_copy(update={"scanner": config.scanner.model_copy(update=scanner)})


CONFIG = with_board(load_config("display-1511"), transport="serial", port="/dev/ttyACM0")


def find_times_us(text):
    return [float(time) for time in re.findall(r"([\d.]+) µs", text)]


def test_a_servo_that_nobody_measured_is_a_warning_with_the_gain_of_measuring_it():
    assert MEASURED == HALF_WIDTH_MIN
    finding = check_mirrors(CONFIG)
    assert finding.status == "warning"
    assert "1.7 kHz ± 10 %" in finding.observation
    (stated_us,) = find_times_us(finding.observation)
    table = DisplayModel.from_config(CONFIG).scan_heads[0].settling
    assert stated_us == table.settling_us(table.pitch_rad, 0.0, table.long_dwell_us)
    (measured_us,) = find_times_us(finding.remedy)
    half_widths = dict.fromkeys(("bandwidth_uncertainty", "damping_uncertainty", "slew_uncertainty"), HALF_WIDTH_MIN)
    measured = check_mirrors(with_scanner(CONFIG, **half_widths, mirrors="/lab/mirrors.toml"))
    assert measured.status == "ok"
    assert "mirrors.toml: 1.7 kHz ± 2 %" in measured.observation
    assert find_times_us(measured.observation) == [measured_us]
    assert measured_us < stated_us


@pytest.mark.parametrize("name", ["display-16", "display-1"])
def test_simulated_mirrors_are_as_stated(name):
    assert check_mirrors(load_config(name)).status == "ok"


def test_a_servo_that_no_plan_can_use_is_a_problem():
    finding = check_mirrors(with_scanner(CONFIG, slew_rad_per_s=1.0))
    assert finding.status == "problem"
    assert "slew_rad_per_s" in finding.observation
