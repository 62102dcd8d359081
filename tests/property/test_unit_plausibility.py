"""Recordings and configurations with one quantity in a wrong unit are refused in one line, sound ones are not."""

import tomllib
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from labs import lab
from optodrive.core.errors import InputError
from optodrive.core.plausibility import OTHER_UNITS, collect_ranges
from optodrive.device.config import Config
from optodrive.device.config_file import load_config, locate_shipped
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.nominal_fit import BROAD_PRIOR
from optodrive.lab.diagnosis.prediction import ParameterPoint
from optodrive.lab.diagnosis.recording_checks import check_recording_units
from optodrive.lab.recording.checks import pop_ambient_k
from sound_files import FIRST_SEEDS, write_toml
from sound_recordings import NAMES, WRONG_UNITS, mistake_units, sound_recording

REFERENCE = ParameterPoint(BROAD_PRIOR.mean, {}).pixel()
DRAWS = [
    ("development", 60),
    pytest.param("report", 1000, marks=[pytest.mark.slow, pytest.mark.timeout(1200)]),
]
"""Seeds, and the number of sound recordings or configurations, each of which is then changed."""
REFUSED_SHARE = 0.99
CONFIG_RANGES = collect_ranges(Config)


def _refusal(check, *arguments):
    """Return the message of the refusal, or an empty one."""
    try:
        check(*arguments)
    except InputError as error:
        return str(error)
    return ""


def _check(recording):
    """Check a recording as the reader and the commands that use it do."""
    for run in recording.runs:
        pop_ambient_k(run.name, {"ambient_K": run.ambient_k})
    check_recording_units(recording, REFERENCE)


def _names(message, quantity, unit):
    is_placed = quantity.split("/")[0].split(",")[0].split(" ")[0] in message
    return "\n" not in message and is_placed and unit in message.partition("likely")[2]


@pytest.mark.parametrize(("seeds", "count"), DRAWS)
def test_sound_recordings_pass_and_wrong_units_are_named(seeds, count):
    refused, missed, tried, seed = [], Counter(), 0, FIRST_SEEDS[seeds]
    while tried < count:
        seed += 1
        rng = np.random.default_rng([7, seed])
        sound = sound_recording(rng)
        message = _refusal(_check, sound)
        if message:
            refused.append((seed, message))
        mistaken = mistake_units(rng, sound)
        if mistaken is None:
            continue
        recording, quantity, unit = mistaken
        tried += 1
        message = _refusal(_check, recording)
        if not _names(message, quantity, unit):
            missed[quantity, unit, message] += 1
    sound_count = seed - FIRST_SEEDS[seeds]
    print(f"{seeds}: {tried} wrong, {missed.total()} missed; {sound_count} sound, {len(refused)} refused")
    assert refused == []
    assert sound_count < 1.25 * count
    assert missed.total() <= max(1, (1.0 - REFUSED_SHARE) * tried), missed


@pytest.mark.parametrize(("seeds", "count"), DRAWS)
def test_recordings_whose_clock_is_offset_pass(seeds, count):
    refused = []
    for seed in range(FIRST_SEEDS[seeds], FIRST_SEEDS[seeds] + count):
        rng = np.random.default_rng([7, seed])
        sound, late_s = sound_recording(rng), rng.uniform(-3e-3, 3e-3)
        runs = [
            replace(run, signals={name: replace(item, t_s=item.t_s + late_s) for name, item in run.signals.items()})
            for run in sound.runs
        ]
        message = _refusal(_check, type(sound)(tuple(runs)))
        if message:
            refused.append((seed, late_s, message))
    assert refused == []


@pytest.mark.parametrize("quantity", [*NAMES, "power_W", "width_s", "t_s"])
def test_a_diagnosis_refuses_before_it_fits(quantity):
    key = next(key for key in WRONG_UNITS if key[0] == quantity)
    clean = lab(31, {}, groups=("middle", "strong"), repeats=2)
    runs = [_with_force(run) for run in clean.runs] if quantity == "force_N" else clean.runs
    recording = type(clean)(tuple(WRONG_UNITS[key](run) for run in runs))
    assert _names(_refusal(diagnose, recording), *key)


def _with_force(run):
    lifted = run.signals["displacement_m"]
    return replace(run, signals={"force_N": replace(lifted, value=60.0 * lifted.value)})


SHIPPED = locate_shipped("display-16.toml").read_text()
FACTORS = {
    "display.pitch_m": (1.0, 1.5),
    "laser.max_power_w": (0.3, 4.0),
    "laser.pwm_hz": (1.0, 4.0),
    "scanner.bandwidth_hz": (0.3, 3.0),
    "scanner.delay_s": (0.5, 3.0),
    "scanner.slew_rad_per_s": (0.5, 5.0),
    "scanner.focal_length_m": (0.5, 2.0),
    "scanner.range_rad": (0.5, 2.0),
    "scanner.aim_error_m": (0.3, 1.2),
    "limits.galvo_acceleration_rms_max_rad_per_s2": (0.5, 5.0),
    "limits.galvo_mean_s": (0.5, 5.0),
    "limits.pulse_energy_max_j": (0.3, 3.0),
    "limits.pulse_gap_min_s": (0.5, 4.0),
    "limits.pixel_mean_window_s": (0.5, 5.0),
    "limits.display_mean_window_s": (0.3, 3.0),
    "board.lease_s": (0.3, 5.0),
}
"""Keys that sound configurations vary, and the factors within which they do."""
CHOICES = {
    "limits.absorber_max_c": (*range(150, 541, 10), *range(150, 541, 10), *range(151, 423, 7), 527),
    "limits.wall_max_c": range(50, 121, 5),
    "ambient_c": range(10, 36),
}


def _sound_table(rng):
    table = tomllib.loads(SHIPPED)
    for key, (low, high) in FACTORS.items():
        section, name = key.split(".")
        table[section][name] = float(table[section][name] * np.exp(rng.uniform(np.log(low), np.log(high))))
    for key, values in CHOICES.items():
        _set(table, key, float(rng.choice(values)))
    return table


def _set(table, key, value):
    *sections, name = key.split(".")
    for section in sections:
        table = table[section]
    table[name] = value


def _get(table, key):
    for part in key.split("."):
        table = table.get(part, {})
    return table


@pytest.mark.parametrize(("seeds", "count"), DRAWS)
def test_sound_configurations_pass_and_wrong_units_are_named(seeds, count, tmp_path):
    refused, missed, tried = [], Counter(), 0
    path = tmp_path / "display.toml"
    for seed in range(count):
        rng = np.random.default_rng([10, FIRST_SEEDS[seeds] + seed])
        table = _sound_table(rng)
        message = _refusal(load_config, write_toml(path, table))
        if message:
            refused.append((seed, message))
        keys = [key for key in CONFIG_RANGES if isinstance(_get(table, key), float | int)]
        key = keys[int(rng.integers(len(keys)))]
        other = OTHER_UNITS[CONFIG_RANGES[key].unit][0]
        digits = 0 if other.name == "K" and rng.random() < 0.5 else 9  # many write 293 K for 20 °C
        _set(table, key, round((_get(table, key) - other.offset) / other.factor, digits))
        tried += 1
        message = _refusal(load_config, write_toml(path, table))
        if not _names(message, key, other.name):
            missed[key, other.name, message] += 1
    print(f"{seeds}: {tried} wrong, {missed.total()} missed; {count} sound, {len(refused)} refused")
    assert refused == []
    assert missed.total() <= max(1, (1.0 - REFUSED_SHARE) * tried), missed


@pytest.mark.parametrize("name", ["display-1", "display-16", "display-357", "display-437", "display-1511"])
def test_the_shipped_configurations_are_plausible(name):
    load_config(name)
