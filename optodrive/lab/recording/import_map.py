"""The map of an import: which column of an instrument's file is which signal, in which unit, of which pixel.

Nothing is taken for granted: a unit, the direction in which a sensor counts, and the instant at which the light's times
begin are stated in the map. A proposal fills in what the file states and leaves the rest to be stated.
"""

import json
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from optodrive.core.toml_model import Section, check_format, parse_table, read_toml
from optodrive.lab.recording.instrument_files import InstrumentFile, find_unit
from optodrive.lab.recording.storage import SIGNALS, UNITS

FORMAT, VERSION = "optodrive-import", 1


class TimeSection(Section):
    """Times of the samples."""

    trigger_s: float
    """Time of the file at which the run begins, s: the zero of the pulses' times."""
    column: str | None = None
    """Column of the times. Without it, those that the file's rate implies, or `rate_hz`."""
    unit: str | None = None
    """Unit of the column, where the file states none."""
    rate_hz: Annotated[float, Field(gt=0.0)] | None = None
    """Samples per second, where the file states no times."""


class SignalSection(Section):
    """One signal."""

    column: str
    """Column of the values: its name, or table/name."""
    sign: Literal[1, -1]
    """-1 if the column falls while the membrane rises, the absorber heats or the force grows."""
    pixel: Annotated[int, Field(ge=0)] | None = None
    """The measured pixel; none for mirrors."""
    unit: str | None = None
    """Unit of the column, where the file states none."""
    scale: float | None = None
    """SI units of the signal per unit of the column, as the sensor's data sheet states: m per V."""
    offset: float = 0.0
    """Value of the signal at 0 of the column, in its SI unit; with `scale` alone."""
    sigma: Annotated[float, Field(ge=0.0)] | None = None
    """Noise that the instrument states, in the signal's SI unit."""


class GateSection(Section):
    """A column that shows when the laser is on, from which the pulses are read."""

    column: str
    threshold: float
    """Above it, in the numbers of the file, the laser is on."""
    power_w: Annotated[float, Field(gt=0.0)]
    """Incident power while the laser is on."""
    pixel: Annotated[int, Field(ge=0)]
    """The pixel at which the beam aims."""


class RunSection(Section):
    """One run, of one file."""

    file: str
    """Path of the file, relative to the map."""
    ambient_k: float
    pulses: str | None = None
    """CSV file of the pulses: start_s, width_s, power_W, pixel. Without it and [gate], the run has none."""
    group: str | None = None
    started_at: str | None = None
    coupling: Literal["DC", "AC"] | None = None


class ImportMap(Section):
    """Meaning of the columns in the files of some runs."""

    format: Literal["optodrive-import"]
    version: Literal[1]
    time: TimeSection
    signals: Annotated[dict[str, SignalSection], Field(min_length=1)]
    runs: Annotated[dict[str, RunSection], Field(min_length=1)]
    gate: GateSection | None = None


def read_map(path: Path) -> ImportMap:
    """Read a map. Raise InputError with the key, the value and the expectation."""
    table = read_toml(path)
    check_format(path, table, FORMAT, VERSION)
    return parse_table(path, table, ImportMap)


def propose_map(files: list[InstrumentFile]) -> str:
    """Return the text of a map, with a comment to fill in for each value that the first file does not state."""
    columns = files[0].columns
    units = {column.key: find_unit(column.unit) for column in columns}
    time = next((key for key, unit in units.items() if unit is not None and unit[0] == "s"), None)
    lines = [f'format = "{FORMAT}"', f"version = {VERSION}", "", "[time]"]
    lines += [] if time is None else [f"column = {_quote(time)}"]
    if time is None and all(column.t_s is None for column in columns):
        lines.append("# rate_hz = …  # or column = …, unit = …: the file states no times")
    lines.append("# trigger_s = …  # time of the file at which the light's times begin")
    for column in columns:
        unit = units[column.key]
        fitting = [] if unit is None else [name for name in SIGNALS if UNITS[name] == unit[0]]
        if column.key == time or (unit is not None and not fitting and unit[0] not in ("V", "A")):
            continue
        name = fitting[0] if len(fitting) == 1 else "…"
        lines += ["", f"# [signals.{name}]  # one of {', '.join(fitting or SIGNALS)}"]
        lines.append(f"# column = {_quote(column.key)}  # unit of the file: {column.unit or 'none'}")
        lines += ["# sign = 1  # or -1", "# pixel = …"]
        lines += [] if fitting else ["# scale = …  # SI units per unit of the column, of the sensor's data sheet"]
    lines += ["", "# [gate]  # a column that shows when the laser is on", "# column = …", "# threshold = …"]
    lines += ["# power_w = …", "# pixel = …"]
    for file in files:
        lines += ["", f"[runs.{_quote(file.path.stem)}]", f"file = {_quote(str(file.path))}", "# ambient_k = …"]
    return "\n".join(lines) + "\n"


def _quote(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
