"""Every number of a configuration is a number: no boolean, no text, nothing outside its range."""

import tomllib
from typing import get_args

import pytest

from optodrive.core.errors import InputError
from optodrive.core.plausibility import collect_ranges
from optodrive.core.toml_model import Section
from optodrive.device.config import Config
from optodrive.device.config_file import load_config, locate_shipped
from sound_files import write_toml

SHIPPED = tomllib.loads(locate_shipped("display-16.toml").read_text())
NOT_CHECKED = ("version", "stages")


def list_keys(model, accepts, place=()):
    """Yield the place of every key whose type `accepts` it, in all sections. A list stands for its items."""
    for name, field in model.model_fields.items():
        kinds, found = [field.annotation], []
        while kinds:
            kind = kinds.pop()
            found.append(kind)
            kinds += get_args(kind)
        for kind in found:
            if isinstance(kind, type) and issubclass(kind, Section) and name not in NOT_CHECKED:
                yield from list_keys(kind, accepts, (*place, name))
        if name not in NOT_CHECKED and any(accepts(kind) for kind in found):
            yield (*place, name)


def load_with(folder, place, value):
    """Load the shipped configuration of 16 pixels with one value replaced."""
    table = {key: dict(item) if isinstance(item, dict) else item for key, item in SHIPPED.items()}
    section = table
    for key in place[:-1]:
        section[key] = dict(section.get(key, {"port": "/dev/ttyS0"} if key == "sensor" else {}))
        section = section[key]
    section[place[-1]] = value
    return load_config(write_toml(folder / "display.toml", table))


NUMBERS = sorted(list_keys(Config, lambda kind: kind in (int, float)))
WHOLE_NUMBERS = sorted(set(list_keys(Config, lambda kind: kind is int)) - {("display", "missing")})


def test_the_walk_finds_the_numbers_of_every_section():
    assert {place[0] for place in NUMBERS} >= {"ambient_c", "display", "panel", "laser", "scanner", "limits", "board"}
    assert ("limits", "uncertainty", "panel_capacity") in NUMBERS
    assert len(NUMBERS) > 50


@pytest.mark.parametrize("value", [True, "4", "0.1", [0.1]])
def test_no_number_is_a_boolean_a_text_or_a_list(tmp_path, value):
    for place in NUMBERS:
        with pytest.raises(InputError) as refused:
            load_with(tmp_path, place, value)
        assert ".".join(place) in str(refused.value)
        assert "\n" not in str(refused.value)


def test_no_whole_number_has_a_decimal_point(tmp_path):
    for place in WHOLE_NUMBERS:
        with pytest.raises(InputError, match=place[-1]):
            load_with(tmp_path, place, 4.0)


@pytest.mark.parametrize("value", [True, 1.0, 4.0, "1"])
def test_a_version_is_a_whole_number(tmp_path, value):
    with pytest.raises(InputError, match=f"version: got {value!r}, expected 1, the one this release reads"):
        load_with(tmp_path, ("version",), value)


@pytest.mark.parametrize("value", [1e6, 1e9, 1e12, 1e305])
def test_no_number_lies_outside_the_range_that_it_can_have(tmp_path, value):
    places = [key.split(".") for key in collect_ranges(Config) if not key.startswith("stages")]
    for place in places:
        if value > collect_ranges(Config)[".".join(place)].high:
            with pytest.raises(InputError, match=place[-1]):
                load_with(tmp_path, place, value)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("panel", "width_m"), True, "panel.width_m: got True"),
        (("panel", "width_m"), "0.1", "panel.width_m: got '0.1'"),
        (("panel", "resistance_k_per_w"), 1e9, "panel.resistance_k_per_w: got 1000000000.0, expected .* 1000 K/W"),
        (("panel", "capacity_j_per_k"), 1e12, "panel.capacity_j_per_k: got 1000000000000.0, expected .* 100000 J/K"),
        (("display", "rows"), "4", "display.rows: got '4'"),
        (("daemon", "host"), "", "daemon.host: got '', expected an address of this computer"),
        (("daemon", "hosts"), ["https://lab.example"], r"daemon.hosts.0: got .* without scheme, port and path"),
        (("daemon", "hosts"), ["lab.example", "lab.example:443"], r"daemon.hosts.1: got 'lab.example:443'"),
        (("daemon", "hosts"), ["fd00::1"], r"as in lab.example or \[fd00::1\]"),
        (("limits", "stage_skew_max_s"), 0, "stage_skew_max_s: got 0, expected greater than 0"),
        (("display", "pitch_m"), 1.0e-3, "display.absorber_width_m: got 0.002, expected less than pitch_m 0.001"),
        (("display", "absorber_height_m"), 4.1e-3, "display.absorber_height_m: got 0.0041, expected less than pitch_m"),
    ],
)
def test_what_was_accepted_is_refused_by_name(tmp_path, place, value, message):
    with pytest.raises(InputError, match=message):
        load_with(tmp_path, place, value)


def test_a_key_in_another_section_is_told_its_own(tmp_path):
    sections = {name: table for name, table in SHIPPED.items() if isinstance(table, dict)}
    places = [("", key) for key in ("ambient_c", "name")]
    places += [(name, key) for name, table in sections.items() for key in table if key != "parameters"]
    moved = 0
    for home, key in places:
        for other in sections:
            if other == home or key == other:
                continue
            with pytest.raises(InputError) as refused:
                load_with(tmp_path, (other, key), 1)
            message = str(refused.value)
            assert f"{other}.{key}: got '{key}', expected this key " in message
            assert (f"in '{home}'" if home else "at the top level") in message
            moved += 1
    assert moved > 150
