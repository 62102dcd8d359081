"""A key that nothing reads is refused by name in every table of every file: a misspelt one would have no effect."""

import copy
import json
import pkgutil
import tomllib
from importlib import import_module

import pytest
from test_mutated_files import list_files

import optodrive
from optodrive.core.errors import InputError
from optodrive.core.json_model import JsonModel
from optodrive.core.toml_model import Section
from optodrive.daemon.api.client_sockets import parse_fingers
from optodrive.daemon.api.openapi import SEQUENCE_EXAMPLE
from optodrive.device.config_file import load_config
from optodrive.physics.parameters import load_parameters
from optodrive.planning.stimuli.frame_json import parse_live_frame
from optodrive.planning.stimuli.sequence_file import parse_sequence
from optodrive.study.study_file import EXPERIMENTS, list_shipped_studies, load_study
from optodrive.study.trial_stimulus import check_stimuli
from sound_files import write_toml

FREE = {
    ("mirrors.toml", "about"),
    ("mirrors.toml", "axes"),
    ("field.toml", "about"),
    ("pixels.toml", "about"),
    *((f"{name}.toml", "factors") for name in list_shipped_studies()),
}
"""Tables whose keys are free: what a file was made from, for people, and factors."""
UNKNOWN = "surely_unknown"
DISPLAY = load_config("display-437")
READERS = {"calibrated.toml": load_parameters, "display-437.toml": lambda path: load_config(str(path))}
"""Readers that are faster than those that plan with the file."""


def list_tables(table, path=()):
    """List the path of every table within a table, of an array's the first one's."""
    yield path
    for key, value in table.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            yield from list_tables(value[0], (*path, key, 0))
        elif isinstance(value, dict):
            yield from list_tables(value, (*path, key))


def add_key(table, path, key):
    """Return the table with a further key in one of its tables."""
    changed = copy.deepcopy(table)
    inner = changed
    for part in path:
        inner = inner[part]
    inner[key] = 1
    return changed


def list_sound_files(folder):
    """List one file of each format, and every study: name, table, reader."""
    for name, text, read in list_files(folder):
        if not name.startswith(("display-", "calibrated")) or name in READERS:
            yield name, tomllib.loads(text), READERS.get(name, read)
    for name in list_shipped_studies():
        yield (
            f"{name}.toml",
            tomllib.loads((EXPERIMENTS / f"{name}.toml").read_text()),
            lambda path: check_stimuli(load_study(str(path)), DISPLAY),
        )


def test_every_table_of_every_file_refuses_a_key_that_it_does_not_have(tmp_path):
    silent, tables = [], 0
    for name, table, read in list_sound_files(tmp_path):
        path = tmp_path / name
        path.touch(mode=0o600)
        read(write_toml(path, table))
        for place in list_tables(table):
            dotted = ".".join(str(part) for part in place)
            if (name, dotted) in FREE:
                continue
            tables += 1
            try:
                read(write_toml(path, add_key(table, place, UNKNOWN)))
                silent.append(f"{name}: {dotted}")
            except InputError as error:
                if UNKNOWN not in str(error):
                    silent.append(f"{name}: {dotted}: {error}")
    assert not silent, silent
    assert tables > 100


def list_models(kind):
    for model in kind.__subclasses__():
        yield model
        yield from list_models(model)


@pytest.mark.parametrize("kind", [Section, JsonModel])
def test_every_model_forbids_what_it_does_not_state(kind):
    for module in pkgutil.walk_packages(optodrive.__path__, "optodrive."):
        if not module.name.endswith("__main__"):
            import_module(module.name)
    models = list(list_models(kind))
    assert len(models) > 50
    assert [model for model in models if model.model_config.get("extra") != "forbid"] == []


@pytest.mark.parametrize(
    ("place", "key", "nearest"),
    [
        ((), "label", "labels"),
        (("frames", 0), "simultanous", "simultaneous"),
        (("frames", 1), "target_um_", "target_um"),
        (("trains", 0), "power_mw", "power_w"),
        (("trains", 1), "peak_to_peak", "peak_to_peak_um"),
        (("trains", 2), "priorty", "priority"),
    ],
)
def test_a_sequence_names_the_nearest_key(place, key, nearest):
    with pytest.raises(InputError, match=f"got '{key}', expected a known key, nearest is '{nearest}'") as refused:
        parse_sequence(add_key(SEQUENCE_EXAMPLE, place, key), load_config("display-16"), "body")
    assert refused.value.code == "unknown_key"


def test_messages_of_streams_and_trackers_name_the_nearest_key():
    with pytest.raises(InputError, match="frame: got 'target', expected a known key, nearest is 'target_um'"):
        parse_live_frame('{"frame": 1, "target_um": {}, "target": 3}', 1, 16)
    finger = {"number": 1, "x_m": 0.0, "y_m": 0.0, "radius_m": 0.005}
    for message, nearest in (
        ({"fingers": [], "ages_s": 0.5}, "age_s"),
        ({"fingers": [finger, finger | {"radius_mm": 5}]}, "radius_m"),
    ):
        with pytest.raises(InputError, match=f"expected a known key, nearest is '{nearest}'"):
            parse_fingers(json.dumps(message))
