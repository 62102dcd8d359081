"""Random sound files of every format, and the same with one quantity in a wrong unit."""

import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hidden_field import CONFIG as FIELD_CONFIG
from hidden_field import PRIOR, grid_codes, measure_spots
from optodrive.core.errors import InputError
from optodrive.core.plausibility import FRAMES, OTHER_UNITS, PlausibleRange, collect_ranges
from optodrive.device.calibrated_field import _FieldFile, load_field
from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import MirrorsFile, apply_measured_servo, load_config, locate_shipped
from optodrive.device.field_geometry import FieldGeometry
from optodrive.device.pixel_map import _PixelMapFile, load_pixel_map, replace_pixel_map
from optodrive.lab.calibration.pictures import _PicturesFile, read_picture_folder
from optodrive.lab.calibration.spot_checks import check_spots
from optodrive.lab.calibration.spots import COLUMNS, read_spots
from optodrive.link.simulator.true_geometry import GroundTruthGeometry
from optodrive.physics.parameters import ParameterSet, load_parameters
from optodrive.physics.terms import discover_terms
from optodrive.planning.stimuli.sequence_file import parse_sequence

CONFIG = load_config("display-16")
PIXEL_COUNT = len(build_pixel_layout(CONFIG.display))
CALIBRATED = locate_shipped("parameters", "calibrated.toml").read_text()
FIRST_SEEDS = {"development": 9_000_000, "report": 3_000_000}
"""Nothing is tuned on the report seeds."""


FRAME_UNITS = {
    "target_um": ("m", "mm", "nm"),
    "peak_to_peak_um": ("mm",),
    "power_w": ("mW",),
    "pulse_width_s": ("ms", "µs"),
    "gap_s": ("ms",),
    "period_s": ("ms",),
}
"""Units that quantities of a sequence are mistaken for."""


@dataclass(frozen=True)
class Mistake:
    """A file with one quantity in a wrong unit: its content, the quantity and the unit as a refusal names them."""

    content: dict
    quantity: str
    unit: str


def to_unit(value, unit, other):
    """Return a number of this unit in one of the units that it is mistaken for, as a person would round it."""
    item = next(each for each in OTHER_UNITS[unit] if each.name == other)
    return float(f"{(value - item.offset) / item.factor:.6g}")


def change(table, path, convert):
    """Return a copy of nested tables with the numbers at a path converted.

    A path leads through every item of lists.
    """
    if not path:
        return [convert(item) for item in table] if isinstance(table, list) else convert(table)
    if isinstance(table, list):
        return [change(item, path, convert) for item in table]
    return {key: change(item, path[1:], convert) if key == path[0] else item for key, item in table.items()}


def find_value(table, path):
    for part in path:
        table = [item[part] for item in table if part in item] if isinstance(table, list) else table.get(part, {})
    return table


def vary(rng, value, factor):
    return float(f"{value * np.exp(rng.uniform(-np.log(factor), np.log(factor))):.4g}")


def write_toml(path, table):
    """Write nested tables as TOML."""
    lines = []

    def add(prefix, values):
        scalars = {key: value for key, value in values.items() if not isinstance(value, dict)}
        lines.extend(f"{format_key(key)} = {format_toml(value)}" for key, value in scalars.items())
        for key, value in values.items():
            if isinstance(value, dict):
                lines.append(f"[{prefix}{format_key(key)}]")
                add(f"{prefix}{format_key(key)}.", value)

    add("", table)
    path.write_text("\n".join(lines) + "\n")
    return path


def format_key(key):
    return key if re.fullmatch(r"[\w-]+", key, re.ASCII) else json.dumps(key)


def format_toml(value):
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(format_toml(item) for item in value)}]"
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{format_key(key)} = {format_toml(item)}' for key, item in value.items())} }}"
    return repr(value)


class Format:
    """A format: draws sound content, changes a quantity, and reads the file as the product does."""

    name = ""
    ranges: Mapping[str, PlausibleRange] = {}

    def list_places(self, content):
        """Return the quantities of a content: path, unit and name in a refusal."""
        places = []
        for key, item in self.ranges.items():
            path = tuple(key.split("."))
            values = find_value(content, path)
            if isinstance(values, list) and len(values) and isinstance(values[0], list):
                values = [number for row in values for number in row]
            numbers = values if isinstance(values, list) else [values]
            if any(isinstance(number, float) and number != 0.0 for number in numbers):
                places.append((path, item.unit, path[-1] if path[-1] != "value" else path[-2]))
        return places

    def mistake(self, rng, content):
        """Return a copy of the content with one quantity in the likeliest wrong unit."""
        places = self.list_places(content)
        path, unit, quantity = places[int(rng.integers(len(places)))]
        other = OTHER_UNITS[unit][0].name
        return Mistake(change(content, path, lambda value: to_unit(value, unit, other)), quantity, other)


class Parameters(Format):
    """A parameter set with one or two terms, typed by a person, with its sigmas."""

    name = "parameters"
    ranges = collect_ranges(ParameterSet)

    def draw(self, rng):
        table = tomllib.loads(CALIBRATED)
        for key in ("tau_g", "kappa", "phi", "R_width_product", "C_mean"):
            table[key]["value"] = vary(rng, table[key]["value"], 2.5)
            table[key]["sigma"] = float(f"{table[key]['value'] * rng.uniform(0.02, 0.4):.3g}")
        for row in table["bridge"]:
            row["R"]["value"], row["C"]["value"] = vary(rng, row["R"]["value"], 2.0), vary(rng, row["C"]["value"], 2.0)
        free = [key for key, term in discover_terms().items() if not term.requires]
        keys = rng.choice(free, int(rng.integers(1, 3)), replace=False).tolist()
        table["terms"] = {
            key: {
                item.name: {
                    "value": self._draw_value(rng, item),
                    "unit": item.unit,
                    "source": "drawn",
                }
                for item in discover_terms()[key].parameters
            }
            for key in keys
        }
        return table

    @staticmethod
    def _draw_value(rng, item):
        value = item.default * float(rng.uniform(0.4, 2.5))
        return float(f"{min(max(value, item.low), item.high):.4g}")

    def list_places(self, content):
        places = super().list_places(content)
        places += [
            ((key, "sigma"), self.ranges[f"{key}.value"].unit, key)
            for key in ("tau_g", "kappa", "phi", "R_width_product", "C_mean")
        ]
        for key, values in content["terms"].items():
            places += [
                (("terms", key, item.name, "value"), item.unit, item.name)
                for item in discover_terms()[key].parameters
                if item.unit != "1" and values[item.name]["value"] != 0.0
            ]
        return places

    def read(self, folder, content):
        load_parameters(write_toml(folder / "model.toml", content))


class Mirrors(Format):
    """mirrors.toml."""

    name = "mirrors"
    ranges = collect_ranges(MirrorsFile)

    def draw(self, rng):
        servo = {"bandwidth_hz": vary(rng, 1500.0, 4.0), "damping": float(rng.uniform(0.35, 0.85))}
        servo |= {"delay_s": vary(rng, 4e-5, 5.0), "slew_rad_per_s": vary(rng, 100.0, 4.0)}
        return {"format": "optodrive-mirrors", "version": 1, "scanner": servo}

    def read(self, folder, content):
        apply_measured_servo(CONFIG, write_toml(folder / "mirrors.toml", content))


class FieldFile(Format):
    """field.toml, in lengths: a command writes it, and its smallest angles look the same in degrees."""

    name = "field"
    ranges = collect_ranges(_FieldFile)

    def draw(self, rng):
        geometry = FieldGeometry(*(np.array(PRIOR.mean) + 0.7 * PRIOR.sigma * rng.standard_normal(len(PRIOR.sigma))))
        size = 25
        scanner = FIELD_CONFIG.scanner
        return {
            "format": "optodrive-field",
            "version": 1,
            "scanner": {"rad_per_code": scanner.rad_per_code, "focal_length_m": scanner.focal_length_m},
            "extent": {"x_code": 32768.0, "y_code": 32768.0, "x_half": 9000.0, "y_half": 9000.0},
            "geometry": {key: float(value) for key, value in geometry._asdict().items()},
            "surface": {
                "order": 6,
                **{f"{axis}_m": (1e-5 * rng.standard_normal(size)).tolist() for axis in "xy"},
            },
            "uncertainty": {"sigma_m": (1e-6 * rng.uniform(2.0, 9.0, (4, 4))).tolist()},
        }

    def list_places(self, content):
        lengths = ("focal_length_m", "mirror_distance_m", "lens_distance_m")
        return [place for place in super().list_places(content) if place[2] in lengths]

    def read(self, folder, content):
        load_field(write_toml(folder / "field.toml", content))


class Pixels(Format):
    """pixels.toml."""

    name = "pixels"
    ranges = collect_ranges(_PixelMapFile)

    def draw(self, rng):
        display = CONFIG.display
        pixels = [
            {
                "index": index,
                "gain": float(rng.uniform(0.6, 1.5)),
                "offset_x_m": float(rng.normal(0.0, 6e-5)),
                "offset_y_m": float(rng.normal(0.0, 6e-5)),
                "offset_x_sigma_m": float(rng.uniform(5e-6, 2e-5)),
                "offset_y_sigma_m": float(rng.uniform(5e-6, 2e-5)),
            }
            for index in range(PIXEL_COUNT)
        ]
        shape = {"name": CONFIG.name, "rows": display.rows, "columns": display.columns}
        return {
            "format": "optodrive-pixels",
            "version": 1,
            "display": shape | {"pitch_m": display.pitch_m, "missing": list(display.missing)},
            "model": {"parameters": ""},
            "map": {"pixels": pixels},
        }

    def read(self, folder, content):
        load_pixel_map(replace_pixel_map(CONFIG, write_toml(folder / "pixels.toml", content)))


class Pictures(Format):
    """pictures.toml: a grid that is turned by a multiple of a right angle and a little."""

    name = "pictures"
    ranges = collect_ranges(_PicturesFile)

    def draw(self, rng):
        turn = float(rng.choice([0.0, 0.5, -0.5, 1.0])) * np.pi + float(rng.normal(0.0, 0.02)) * (rng.random() < 0.3)
        return {
            "format": "optodrive-pictures",
            "version": 1,
            "grid": {
                "kind": "chessboard",
                "rows": 7,
                "columns": 9,
                "pitch_m": vary(rng, 5e-3, 4.0),
                "pictures": ["grid.png"],
            },
            "origin": {
                "marks_px": [[10.0, 10.0], [90.0, 10.0], [10.0, 70.0]],
                "first_corner_m": [round(float(x), 4) for x in rng.uniform(-0.05, 0.05, 2)],
                "turn_rad": round(float(np.clip(turn, -3.2, 3.2)), 4),
            },
            "spots": {"pictures": "spot_*.png"},
        }

    def read(self, folder, content):
        for name in ("grid.png", "spot_32768_32768.png"):
            (folder / name).touch()
        write_toml(folder / "pictures.toml", content)
        read_picture_folder(folder)


class Spots(Format):
    """spots.csv, with both columns or one of them in another unit."""

    name = "spots"
    ranges = dict.fromkeys(("x_m", "y_m"), PlausibleRange(0.0, 0.5, "m"))

    def draw(self, rng):
        truth = GroundTruthGeometry.sample(int(rng.integers(1_000_000)), FIELD_CONFIG)
        spots, _ = measure_spots(truth, grid_codes(int(rng.integers(3, 9))), rng)
        return dict(zip(COLUMNS, spots.to_table().T.tolist(), strict=True))

    def mistake(self, rng, content):
        unit, factor = [("millimetres", 1e3), ("micrometres", 1e6)][int(rng.integers(2))]
        names = [("x_m", "y_m"), ("x_m",), ("y_m",)][int(rng.integers(3))]
        wrong = {key: [value * factor for value in content[key]] for key in names}
        return Mistake(content | wrong, names[0], unit)

    def read(self, folder, content):
        path = folder / "spots.csv"
        rows = zip(*content.values(), strict=True)
        path.write_text("\n".join([",".join(COLUMNS), *(",".join(map(repr, row)) for row in rows)]) + "\n")
        check_spots(str(path), read_spots(path), PRIOR)


class Frames(Format):
    """FRAMES.json. Times at which frames are shown have no physical scale: only those of pulses are mistaken."""

    name = "frames"
    ranges = FRAMES

    def draw(self, rng):
        frames, show_at_s = [], 0.0
        for _ in range(int(rng.integers(0, 6))):
            duration_s = round(float(10 ** rng.uniform(-1.3, 1.3)), 3)
            chosen = rng.choice(PIXEL_COUNT, int(rng.integers(1, PIXEL_COUNT)), replace=False)
            heights = {str(pixel): round(float(10 ** rng.uniform(0.7, 2.7)), 1) for pixel in chosen}
            frames.append({"show_at_s": round(show_at_s, 6), "duration_s": duration_s, "target_um": heights})
            show_at_s += duration_s
        kind = int(rng.integers(2 if frames else 1, 3)) if rng.random() < 0.5 or not frames else 0
        trains = [self._draw_train(rng, kind)] if kind else []
        return {"frames": frames, "trains": trains}

    @staticmethod
    def _draw_train(rng, kind):
        train = {"pixel": int(rng.integers(PIXEL_COUNT)), "start_s": round(float(rng.uniform(0.0, 2.0)), 3)}
        if kind == 1:
            width_s, gap_s = int(rng.integers(5, 250)) * 2e-4, round(float(10 ** rng.uniform(-2.5, 0.3)), 4)
            duration_s = round(float(rng.uniform(3.0, 40.0)) * (width_s + gap_s), 4)
            train |= {"pulse_width_s": width_s, "gap_s": gap_s, "power_w": round(float(rng.uniform(0.1, 2.45)), 3)}
            return train | {"duration_s": duration_s}
        period_s = round(float(10 ** rng.uniform(-2.0, 0.5)), 4)
        height_um = round(float(10 ** rng.uniform(1.0, 2.6)), 1)
        train |= {"period_s": period_s, "duration_s": round(float(rng.uniform(3.0, 40.0)) * period_s, 4)}
        return train | {"target_um": height_um, "peak_to_peak_um": round(height_um * float(rng.uniform(0.2, 1.0)), 1)}

    def mistake(self, rng, content):
        places = [("frames", "target_um")] if content["frames"] else []
        places += [("trains", key) for train in content["trains"] for key in train if key in FRAME_UNITS]
        section, key = places[int(rng.integers(len(places)))]
        unit = str(rng.choice(FRAME_UNITS[key]))

        def convert(value):
            if isinstance(value, dict):
                return {pixel: convert(item) for pixel, item in value.items()}
            return to_unit(value, "µm" if key.endswith("_um") else {"w": "W", "s": "s"}[key[-1]], unit)

        return Mistake(change(content, (section, key), convert), key, unit)

    def read(self, _folder, content):
        parse_sequence(json.dumps(content), CONFIG, "frames.json")


FORMATS = (Parameters(), Mirrors(), FieldFile(), Pixels(), Pictures(), Spots(), Frames())


def read_refusal(item, folder, content):
    """Return the message with which a file is refused, or an empty one."""
    try:
        item.read(folder, content)
    except InputError as error:
        return str(error)
    return ""
