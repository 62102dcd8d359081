"""Recordings from the files of instruments, by a map."""

from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError, Unquoted, suggest_nearest
from optodrive.core.numeric_tables import read_columns
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording import checks
from optodrive.lab.recording.import_map import ImportMap, RunSection, SignalSection, read_map
from optodrive.lab.recording.instrument_files import Column, InstrumentFile, find_unit, read_instrument_file
from optodrive.lab.recording.storage import MIRROR_SIGNALS, PULSES, SIGNALS, TABLE_COLUMNS, UNITS, check_run_name


def import_recording(map_path: Path) -> tuple[Measurement, list[InstrumentFile]]:
    """Return the recording that a map describes, and the files that it was read from. Raise InputError."""
    described = read_map(map_path)
    for name in described.signals:
        if name not in SIGNALS:
            raise InputError(f"{map_path}: signals", name, suggest_nearest(name, list(SIGNALS)))
        if name in MIRROR_SIGNALS:
            raise InputError(
                f"{map_path}: signals", name, "a signal of a pixel; `optodrive calibrate steps` records mirrors"
            )
    runs, files = [], []
    for name, section in described.runs.items():
        check_run_name(f"{map_path}: runs", name)
        file = read_instrument_file(map_path.parent / section.file)
        files.append(file)
        runs.append(_build_run(map_path, described, name, section, file))
    measurement = Measurement(tuple(runs))
    checks.check_sample_count(str(map_path), measurement.runs)
    return measurement, files


def _build_run(map_path: Path, described: ImportMap, name: str, section: RunSection, file: InstrumentFile) -> Run:
    place = f"{map_path}: runs.{name}"
    stated = {"group": section.group, "started_at": section.started_at, "coupling": section.coupling}
    attributes: dict[str, str | float] = {key: value for key, value in stated.items() if value is not None}
    ambient_k = checks.pop_ambient_k(place, attributes | {"ambient_K": section.ambient_k})
    signals = {key: _build_signal(map_path, described, key, each, file) for key, each in described.signals.items()}
    pulses = _build_pulses(map_path, described, section, file)
    checks.check_pulses(f"{place}: {PULSES}", pulses)
    return Run(name, ambient_k, pulses, signals, attributes)


def _build_signal(
    map_path: Path, described: ImportMap, name: str, section: SignalSection, file: InstrumentFile
) -> Signal:
    place = f"{map_path}: signals.{name}"
    if section.pixel is None:
        raise InputError(f"{place}: pixel", section.pixel, "the index of the pixel measured")
    column = file.find(f"{place}: column", section.column)
    scale, offset = _find_scale(place, name, section, column, file)
    t_s = _find_times(map_path, described, column, file)
    value = section.sign * scale * column.value + offset
    # A row without a time is no sample.
    has_time = np.isfinite(t_s)
    t_s, value = t_s[has_time], value[has_time]
    checks.check_samples(f"{file.path}: {column.key}", t_s, value)
    return Signal(section.pixel, t_s, value, section.sigma or None)


def _find_scale(
    place: str, name: str, section: SignalSection, column: Column, file: InstrumentFile
) -> tuple[float, float]:
    """Return SI units per unit of the column, and the value at 0."""
    stated = find_unit(column.unit) if column.unit else None
    if section.unit is not None:
        given = find_unit(section.unit)
        if given is None:
            raise InputError(f"{place}: unit", section.unit, f"a unit of {UNITS[name]}, or scale")
        if stated is not None and stated != given:
            raise InputError(f"{place}: unit", section.unit, f"{column.unit!r}, as {file.path} states, or scale")
        stated = given
    if section.scale is not None:
        if section.scale == 0.0 or not np.isfinite([section.scale, section.offset]).all():
            raise InputError(f"{place}: scale", section.scale, "a finite number other than 0")
        if stated is not None and stated[0] == UNITS[name]:
            raise InputError(f"{place}: scale", section.scale, f"none: the column is in {column.unit or section.unit}")
        return section.scale, section.offset
    if stated is None or stated[0] != UNITS[name]:
        found = column.unit or section.unit
        shown = Unquoted(f"a column in {found}" if found else "a column without a unit")
        raise InputError(f"{place}: column", shown, f"unit, one of {UNITS[name]}, or scale in {UNITS[name]} per unit")
    if section.offset:
        raise InputError(f"{place}: offset", section.offset, "none without scale")
    if section.sign == -1 and stated[2]:
        raise InputError(f"{place}: sign", section.sign, f"1 for a temperature in {column.unit or section.unit}")
    return stated[1], stated[2]


def _find_times(map_path: Path, described: ImportMap, column: Column, file: InstrumentFile) -> FloatArray:
    """Return the times of a column's samples from the trigger on, s."""
    time, place = described.time, f"{map_path}: time"
    if time.column is not None:
        if time.rate_hz is not None:
            raise InputError(f"{place}.rate_hz", time.rate_hz, "column or rate_hz, not both")
        source = file.find(f"{place}.column", time.column)
        unit = time.unit or source.unit
        found = find_unit(unit)
        if found is None or found[0] != "s":
            raise InputError(f"{place}.unit", unit or None, "the unit of the times: s, ms, us, ns or min")
        if time.unit and source.unit and find_unit(source.unit) != found:
            raise InputError(f"{place}.unit", time.unit, f"{source.unit!r}, as {file.path} states")
        if len(source.value) != len(column.value):
            shown = Unquoted(f"{len(source.value)} times for {len(column.value)} values of {column.key!r}")
            raise InputError(f"{place}.column", shown, "as many times as values")
        t_s = found[1] * source.value
    elif time.rate_hz is not None:
        if column.t_s is not None:
            raise InputError(f"{place}.rate_hz", time.rate_hz, f"none: {file.path} states the times of {column.key!r}")
        t_s = np.arange(len(column.value)) / time.rate_hz
    elif column.t_s is not None:
        t_s = column.t_s
    else:
        raise InputError(place, Unquoted(f"no times of {column.key!r} in {file.path}"), "column or rate_hz")
    return np.asarray(t_s - time.trigger_s)


def _build_pulses(map_path: Path, described: ImportMap, section: RunSection, file: InstrumentFile) -> FloatArray:
    """Return the pulses of a file, or those that the laser's column shows, or none."""
    gate = described.gate
    if section.pulses is not None:
        if gate is not None:
            raise InputError(f"{map_path}: gate", Unquoted("[gate] beside pulses"), "one of the two")
        return read_columns(map_path.parent / section.pulses, TABLE_COLUMNS[PULSES])
    if gate is None:
        return np.empty((0, len(TABLE_COLUMNS[PULSES])))
    column = file.find(f"{map_path}: gate.column", gate.column)
    t_s = _find_times(map_path, described, column, file)
    known = np.isfinite(t_s) & np.isfinite(column.value)
    t_s, above = t_s[known], column.value[known] - gate.threshold
    is_on = above > 0.0
    if is_on.all() or not is_on.any():
        shown = Unquoted(f"{gate.threshold:g}, which {column.key!r} never crosses")
        raise InputError(f"{map_path}: gate.threshold", shown, f"between {above.min() + gate.threshold:g} and "
                         f"{above.max() + gate.threshold:g}")  # fmt: skip
    edges = np.flatnonzero(np.diff(is_on.astype(int)))
    share = above[edges] / (above[edges] - above[edges + 1])
    edge_s = t_s[edges] + share * (t_s[edges + 1] - t_s[edges])
    if is_on[0] or is_on[-1]:
        shown = Unquoted(f"{file.path}: a pulse at the {'begin' if is_on[0] else 'end'} of {column.key!r}")
        raise InputError(f"{map_path}: gate", shown, "pulses with both edges within the file")
    start_s, end_s = edge_s[::2], edge_s[1::2]
    rest = (np.full(len(start_s), gate.power_w), np.full(len(start_s), float(gate.pixel)))
    return np.column_stack([start_s, end_s - start_s, *rest])
