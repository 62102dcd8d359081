import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.config_file import list_shipped_configs, load_config, locate_shipped
from optodrive.physics.parameters import load_parameters
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.effective_config import build_effective_config


@pytest.mark.parametrize("name", list_shipped_configs())
def test_shipped_configurations_have_the_pixels_they_are_named_after(name):
    layout = build_pixel_layout(load_config(name).display)
    assert len(layout) == int(name.removeprefix("display-"))
    places = np.column_stack([layout.x_m, layout.y_m])
    assert len(np.unique(places.round(9), axis=0)) == len(layout)
    assert np.abs(places).max() <= 0.076 + 1e-12


def test_pixels_count_by_rows_from_the_lower_left():
    layout = build_pixel_layout(load_config("display-16").display)
    assert layout.x_m[:4] == pytest.approx([-6e-3, -2e-3, 2e-3, 6e-3])
    assert layout.y_m[::4] == pytest.approx([-6e-3, -2e-3, 2e-3, 6e-3])


def test_the_resolved_configuration_carries_what_others_rely_on():
    resolved = build_effective_config(DisplayModel.from_config(load_config())).model_dump(mode="json")
    assert resolved["name"] == "display-437"
    assert len(resolved["display"]["pixels"]) == 437
    assert set(resolved["display"]["pixels"][0]) == {"index", "x_m", "y_m", "bridge_width_m"}
    assert set(resolved["pixel_model"]) >= {"R", "C", "epsilon", "tau_g", "kappa", "phi"}
    assert set(resolved["laser"]) == {
        "max_power_w",
        "pwm_hz",
        "modulation",
        "whole_periods",
        "threshold_w",
        "curve",
        "focus_width_m",
        "focus_height_m",
    }
    assert {"bandwidth_hz", "damping", "delay_s", "slew_rad_per_s", "aim_error_m"} <= set(resolved["scanner"])
    assert resolved["scanner"]["settling_pitch_s"] == pytest.approx(383e-6)
    assert set(resolved["limits"]) >= {
        "absorber_max_c",
        "pulse_energy_max_j",
        "pulse_width_max_s",
        "pixel_mean_power_max_w",
        "display_mean_power_max_w",
    }
    assert {"transport", "port"} <= set(resolved["board"])
    assert resolved["ambient_c"] == 20.0


@pytest.mark.parametrize(
    ("old", "new", "where", "expected"),
    [
        ("damping", "dampin", "scanner.dampin", "nearest is 'damping'"),
        ("[scanner]", "[scaner]", "scaner", "nearest is 'scanner'"),
        ("baud = 1_000_000", "baud = 10", "board.baud", "9600"),
        ('transport = "simulated"', 'transport = "serial"', "board.port", "for transport 'serial'"),
        ('transport = "simulated"', 'transport = "usb"', "board.vendor_id", "for transport 'usb'"),
        ('transport = "simulated"', 'transport = "usb"\nvendor_id = 0x12345', "board.vendor_id", "65535"),
        ('transport = "simulated"', 'transport = "helios"', "scanner.half_range_codes: got 32767", "expected 2047"),
        (
            "damping = 0.7",
            "damping = 0.7\nhalf_range_codes = 2047",
            "scanner.half_range_codes: got 2047",
            "expected 32767",
        ),
        ("baud = 1_000_000", "points_per_s = 60_000", "board.points_per_s", "50000"),
        ("absorber_max_c = 400.0", "absorber_max_c = nan", "absorber_max_c", "finite"),
        ("pulse_width_max_s = 0.050", "pulse_width_max_s = 0.070", "pulse_width_max_s", "0.065535"),
        (
            "pulse_width_max_s = 0.050",
            "pulse_width_max_s = 0.0001",
            "limits.pulse_width_max_s",
            "one period of laser.pwm_hz",
        ),
        (
            "pixel_mean_window_s = 1.0",
            "pixel_mean_window_s = 0.01",
            "limits.pulse_width_max_s",
            "at most limits.pixel_mean_window_s 0.01",
        ),
        ("[0, 0], ", "[0, 99], ", "]: got [0, 99]", "within 21 rows"),
        ("[0, 0], ", "[0, 20], ", "display.missing[", "each place once"),
        ("version = 1", "version = 4", "version", "expected 1, the one this release reads"),
        ("damping = 0.7", "damping = 1.0", "scanner.damping", "less than or equal to 0.9"),
        ("damping = 0.7", "damping = 0.2", "scanner.damping", "greater than or equal to 0.3"),
        (
            "focus_width_m = 1.0e-3",
            "focus_width_m = 1.8e-3",
            "laser.focus_width_m: got 0.0018",
            "on display.absorber_width_m 0.002",
        ),
        ("focus_height_m = 0.5e-3", "focus_height_m = 1.3e-3", "laser.focus_height_m: got 0.0013", "to fit"),
        (
            "[laser]",
            "[laser]\ncurve = [[0, 0], [0.5, 1.5], [0.6, 1.4], [1, 2.45]]",
            "laser.curve[2]: got [0.6, 1.4]",
            "more than 1.5 W, as in the row before",
        ),
        ("[laser]", "[laser]\ncurve = [[0, 0], [0.5, 1], [0.5, 2], [1, 2.45]]", "laser.curve[2]", "a duty above 0.5"),
        ("[laser]", "[laser]\ncurve = [[0, 0], [0.5, 1], [1, 2.4]]", "laser.curve[2]: got [1.0, 2.4]", "[1.0, 2.45]"),
        ("[laser]", "[laser]\ncurve = [[0.1, 0], [1, 2.45]]", "laser.curve[0]: got [0.1, 0.0]", "[0.0, 0.0]"),
        (
            "[laser]",
            "[laser]\ncurve = [[0, 0], [0.1, 0], [0.2, 0.3], [1, 2.45]]",
            "laser.threshold_w: got 0.0",
            "at least 0.3, the first power above 0 of curve",
        ),
        (
            "[laser]",
            '[laser]\nmodulation = "on_off"\ncurve = [[0, 0], [1, 2.45]]',
            "laser.curve: got 2 rows",
            "none with modulation 'on_off'",
        ),
        ("aim_error_m = 1.0e-4", "aim_error_m = 5.0e-4", "laser.focus_width_m", "scanner.aim_error_m 0.0005"),
    ],
)
def test_wrong_values_are_named_with_place_and_expectation(tmp_path, old, new, where, expected):
    text = locate_shipped("display-437.toml").read_text()
    assert old in text
    path = tmp_path / "c.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_config(path)
    assert where in str(caught.value)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("section", "key", "value", "says"),
    [
        ("limits", "power_share", 0.5, "limits.power_share: got 0.5, expected 1 with laser.modulation 'on_off'"),
        (
            "board",
            "transport",
            "helios",
            "laser.modulation: got 'on_off', expected 'pwm' with board.transport",
        ),
    ],
)
def test_what_a_laser_that_is_on_or_off_cannot_do_is_refused(section, key, value, says):
    table = load_config("display-16").model_dump()
    table["laser"]["modulation"], table[section][key] = "on_off", value
    if value == "helios":
        table["scanner"]["half_range_codes"] = 2047
    with pytest.raises(ValueError, match="on_off") as caught:
        Config.model_validate(table)
    found = caught.value.errors()[0]["ctx"]["error"]
    assert says in f"{found.place}: got {found.value!r}, expected {found.expected}"


def test_parameter_sets_carry_unit_and_source_for_every_value():
    for name in ("calibrated", "paper_s1_literal"):
        parameters = load_parameters(name)
        rows = [parameters.epsilon, parameters.tau_g, parameters.kappa, parameters.phi]
        rows += [value for bridge in parameters.bridge for value in (bridge.R, bridge.C)]
        assert all(row.unit and row.source for row in rows)
        assert parameters.claims.strip()


def test_a_bridge_width_between_the_rows_of_table_s3_takes_the_fitted_law():
    parameters = load_parameters("calibrated")
    assert parameters.build_pixel(0.40e-3).r_k_per_w == 184.0
    assert parameters.build_pixel(0.30e-3).r_k_per_w == pytest.approx(73.3 / 0.30)


def test_an_unknown_parameter_set_is_refused(tmp_path):
    with pytest.raises(InputError, match="calibrated"):
        load_parameters("best")
    path = tmp_path / "p.toml"
    path.write_text('format = "optodrive-parameters"\nversion = 7\n')
    with pytest.raises(InputError, match="version"):
        load_parameters(path)


@pytest.mark.parametrize("name", ["a\\u001b[2Jb", "a\\nb", 'a\\"b', "a\\\\b", "", "x" * 101])
def test_a_name_that_fits_no_line_is_refused(name, tmp_path):
    """It is printed by commands, and written into files of TOML."""
    path = tmp_path / "config.toml"
    text = locate_shipped("display-16.toml").read_text()
    path.write_text(text.replace('name = "display-16"', f'name = "{name}"'))
    with pytest.raises(InputError, match=r"config\.toml: name: got") as refused:
        load_config(path)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize("transport", ["ether_dream", "idn"])
def test_a_serial_number_of_a_network_dac_is_refused_and_not_ignored(transport):
    table = load_config("display-16").model_dump()
    table["board"] |= {"transport": transport, "port": "192.168.1.20", "serial_number": "A1"}
    with pytest.raises(ValueError, match="serial_number"):
        Config.model_validate(table)
