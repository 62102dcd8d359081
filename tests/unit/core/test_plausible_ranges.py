"""Every quantity of a file or a recording has a plausible range: one that is added without one fails here."""

import re
import typing
from types import UnionType

import pytest
from pydantic import BaseModel

from optodrive.core.errors import InputError
from optodrive.core.plausibility import (
    FRAMES,
    OTHER_UNITS,
    RECORDING,
    PlausibleRange,
    check_plausible,
    check_table,
    collect_ranges,
)
from optodrive.device.calibrated_field import _FieldFile
from optodrive.device.config import Config
from optodrive.device.config_file import MirrorsFile
from optodrive.device.field_geometry import GEOMETRY_RANGES, FieldGeometry
from optodrive.device.pixel_map import _PixelMapFile
from optodrive.lab.calibration.pictures import _PicturesFile
from optodrive.lab.diagnosis.recording_checks import LENGTHS
from optodrive.lab.recording.storage import SAMPLE_COLUMNS, SIGNALS, TABLE_COLUMNS
from optodrive.physics.parameters import PARAMETER_UNITS, Bridge, ParameterSet
from optodrive.physics.terms import discover_terms
from optodrive.planning.stimuli.frame_json import FRAME_TIMES, TARGET_KEYS
from optodrive.planning.stimuli.pattern_registry import describe_patterns
from optodrive.planning.stimuli.train_json import HEIGHT_TRAIN_KEYS, HEIGHT_TRAIN_TARGETS, PULSE_TRAIN_KEYS

UNITS = {
    "_per_code": "rad",
    "_per_s2": "rad/s²",
    "_per_rad2": "1/rad²",
    "_per_rad4": "1/rad⁴",
    "rad_per_s": "rad/s",
    "_k_per_w": "K/W",
    "_j_per_k": "J/K",
    "_um": "µm",
    "_m": "m",
    "_s": "s",
    "_w": "W",
    "_W": "W",
    "_j": "J",
    "_K": "K",
    "_N": "N",
    "_c": "°C",
    "_hz": "Hz",
    "_rad": "rad",
}
"""Endings of names to units, longer ones first."""
COUNTS = {"board.points_per_s", "stages.board.points_per_s", "daemon.requests_per_s"}
"""Rates of events, of which each has its own bounds."""
MODELS = (Config, MirrorsFile, _FieldFile, _PixelMapFile, _PicturesFile)


def list_models(annotation):
    """Return the models in an annotation: itself, the items of its containers, the parts of a union."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    is_compound = typing.get_origin(annotation) is not None or isinstance(annotation, UnionType)
    return [model for part in typing.get_args(annotation) for model in list_models(part)] if is_compound else []


def list_keys(model, prefix=""):
    """Return the dotted keys of all numbers of a model."""
    keys = []
    for name, item in model.model_fields.items():
        inner = list_models(item.annotation)
        keys += [key for each in inner for key in list_keys(each, f"{prefix}{name}.")] or [prefix + name]
    return keys


def find_unit(key):
    return next((unit for ending, unit in UNITS.items() if key.endswith(ending)), None)


def list_quantities(model):
    """Return the dotted keys of a model's quantities with their units."""
    found = {key: find_unit(key) for key in list_keys(model)}
    return {key: unit for key, unit in found.items() if unit is not None and key not in COUNTS}


def list_stated(ranges):
    return {key: plausible.unit for key, plausible in ranges.items()}


@pytest.mark.parametrize("model", MODELS)
def test_every_quantity_has_a_range_in_its_unit_and_every_range_a_quantity(model):
    stated = list_stated(collect_ranges(model))
    unnamed = {key: unit for key, unit in stated.items() if unit != "1" and not key.startswith("geometry.")}
    assert unnamed == list_quantities(model)


def test_a_new_quantity_without_a_range_is_noticed():
    class Extended(Config):
        settling_time_s: float

    assert set(list_quantities(Extended)) - set(collect_ranges(Extended)) == {"settling_time_s"}


def test_what_is_no_model_has_ranges_too():
    assert list_stated(GEOMETRY_RANGES) == {key: find_unit(key) for key in FieldGeometry._fields if find_unit(key)}
    uncertain = [key for key in list_keys(Config) if key.startswith("limits.uncertainty.")]
    assert dict.fromkeys(uncertain, "1").items() <= list_stated(collect_ranges(Config)).items()
    columns = [f"{name}.{key}" for name in TABLE_COLUMNS for key in TABLE_COLUMNS[name]]
    columns += [f"signal.{key}" for key in SAMPLE_COLUMNS]
    names = (*columns, *SIGNALS, *LENGTHS, "ambient_K")
    units = {name: find_unit(f"_{name.rpartition('.')[2]}") for name in names}
    assert list_stated(RECORDING) == {name: unit for name, unit in units.items() if unit}
    trains = {f"trains.{name}" for name in (*PULSE_TRAIN_KEYS, *HEIGHT_TRAIN_KEYS, *HEIGHT_TRAIN_TARGETS)}
    keys = {f"frames.{name}" for name in (*FRAME_TIMES, *TARGET_KEYS)} | trains
    assert list_stated(FRAMES) == {key: find_unit(key) for key in keys if find_unit(key)}


def test_every_parameter_has_a_range_in_its_unit():
    stated = list_stated(collect_ranges(ParameterSet))
    named = {name: name for name in ParameterSet.model_fields if name in PARAMETER_UNITS}
    named |= {f"bridge.{name}": name for name in Bridge.model_fields if name in PARAMETER_UNITS}
    expected = {f"{key}.value": PARAMETER_UNITS[name] for key, name in named.items()}
    assert stated == expected | {"bridge.width_m": "m"}


def test_another_unit_is_known_for_each_range():
    tables = [RECORDING, FRAMES, *map(collect_ranges, (*MODELS, ParameterSet))]
    assert {item.unit for table in tables for item in table.values()} <= set(OTHER_UNITS)


@pytest.mark.parametrize("key", sorted(discover_terms()))
def test_parameters_of_terms_have_a_bounded_range_in_a_known_unit(key):
    for item in discover_terms()[key].parameters:
        assert item.unit in OTHER_UNITS, item
        assert item.low <= item.default <= item.high, item


def test_parameters_of_patterns_with_a_unit_have_a_range():
    numbers = [item for pattern in describe_patterns() for item in pattern.parameters if item.kind == "number"]
    assert numbers
    for item in numbers:
        assert item.min is not None, item
        assert item.max is not None, item
        assert item.unit in ("", *OTHER_UNITS), item
        ending = re.search(r"_(s|um|mm|hz)$", item.name)
        assert ending is None or item.unit, item


def test_a_table_is_checked_at_any_depth_and_the_place_is_named():
    ranges = {"map.pixels.offset_m": PlausibleRange(0.0, 5e-3, "m"), "grid.corner_m": PlausibleRange(0.0, 0.5, "m")}
    sound = {"map": {"pixels": [{"offset_m": 1e-3}, {"offset_m": -2e-3}]}, "grid": {"corner_m": [0.1, -0.2]}}
    check_table("file", sound, ranges)
    sound["map"]["pixels"][1]["offset_m"] = -2.0
    with pytest.raises(InputError, match=r"file: map.pixels\[1\].offset_m: got -2.0, expected .* likely in mm"):
        check_table("file", sound, ranges)
    sound["map"] = {}
    sound["grid"]["corner_m"] = [0.1, 200.0]
    with pytest.raises(InputError, match=r"grid.corner_m\[1\].*likely in mm"):
        check_table("file", sound, ranges)


@pytest.mark.parametrize("value", [3e10, 1e305, 10**400])
def test_what_no_unit_explains_is_refused(value):
    with pytest.raises(InputError, match=r"file: grid\.corner_m: got .*, expected 0 m to 500 mm$"):
        check_table("file", {"grid": {"corner_m": value}}, {"grid.corner_m": PlausibleRange(0.0, 0.5, "m")})


@pytest.mark.parametrize("value", [float("nan"), float("inf"), True, "5", None, {"deep": 1}])
def test_what_is_no_finite_number_is_left_to_the_schema(value):
    check_table("file", {"grid": {"corner_m": value}}, {"grid.corner_m": PlausibleRange(0.0, 0.5, "m")})


@pytest.mark.parametrize("value", [10**400, 1e308, -1e308, 1e-320])
def test_a_number_that_no_quantity_can_have_is_refused(value):
    """A value computed from it would leave the range of floats."""
    with pytest.raises(InputError, match=r"^file: grid\.corner_m\[0\]: got .*, expected 1 mm to 500 mm$"):
        check_table("file", {"grid": {"corner_m": [value]}}, {"grid.corner_m": PlausibleRange(1e-3, 0.5, "m")})


def test_a_quantity_out_of_range_in_every_unit_is_refused_without_a_guess():
    with pytest.raises(InputError) as caught:
        check_plausible("bridge_width_m", 1e9, PlausibleRange(1e-5, 5e-3, "m"))
    assert "likely" not in str(caught.value)
