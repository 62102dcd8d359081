"""Recordings of measured data: HDF5, format "optotactile-recording", version 1."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optodrive.errors import InputError, nearest
from optodrive.files import written_whole
from optodrive.flow import Measurement, Run, Signal

if TYPE_CHECKING:
    import h5py

FORMAT = "optotactile-recording"
VERSION = 1
SIGNALS = ("absorber_temperature_K", "displacement_m", "force_N", "mirror_x_rad", "mirror_y_rad")
PULSE_COLUMNS = 4
KNOWN_RUN_MEMBERS = ("pulses", "commands")


def _h5py() -> Any:
    try:
        import h5py
    except ImportError:
        raise InputError("h5py", None, "the extra: pip install 'optodrive[analysis]'", "missing_extra") from None
    return h5py


def write_recording(path: Path, measurement: Measurement) -> None:
    """Write a recording, whole or not at all; InputError where the file cannot be written."""
    h5 = _h5py()
    with written_whole(path) as temporary, h5.File(temporary, "w") as file:
        _fill(file, measurement)


def _fill(file: "h5py.File", measurement: Measurement) -> None:
    file.attrs["format"] = FORMAT
    file.attrs["version"] = VERSION
    for run in measurement.runs:
        group = file.create_group(f"runs/{run.name}")
        group.attrs["ambient_K"] = run.ambient_k
        for key, value in run.attributes.items():
            group.attrs[key] = value
        group.create_dataset("pulses", data=run.pulses)
        for name, signal in run.signals.items():
            member = group.create_group(name)
            member.create_dataset("t_s", data=signal.t_s)
            member.create_dataset("value", data=signal.value)
            member.attrs["pixel"] = signal.pixel
            if signal.sigma is not None:
                member.attrs["sigma"] = signal.sigma


def read_recording(path: Path) -> Measurement:
    """Read a recording; InputError with file, run, signal and expectation where it is not one."""
    h5 = _h5py()
    try:
        file = h5.File(path, "r")
    except OSError as error:
        raise InputError(str(path), str(error).split("(")[0].strip(), "a readable HDF5 file") from None
    with file:
        _check_head(path, file)
        runs = file.get("runs")
        if not isinstance(runs, h5.Group) or not len(runs):
            raise InputError(f"{path}: /runs", None, "a group with at least one run")
        return Measurement(tuple(_read_run(f"{path}: /runs/{name}", name, runs[name]) for name in runs))


def _check_head(path: Path, file: "h5py.File") -> None:
    if file.attrs.get("format") != FORMAT:
        raise InputError(f"{path}: format", file.attrs.get("format"), f"'{FORMAT}'")
    if file.attrs.get("version") != VERSION:
        raise InputError(f"{path}: version", file.attrs.get("version"), f"{VERSION}, the one this release reads")


def _read_run(where: str, name: str, group: "h5py.Group") -> Run:
    attributes = dict(group.attrs)
    if "ambient_K" not in attributes:
        raise InputError(f"{where}: ambient_K", None, "the ambient temperature, K")
    if "pulses" not in group:
        raise InputError(f"{where}/pulses", None, "start_s, width_s, power_W, pixel, one row a pulse")
    pulses = np.asarray(group["pulses"], dtype=np.float64)
    if pulses.ndim != 2 or pulses.shape[1] != PULSE_COLUMNS:
        raise InputError(f"{where}/pulses", pulses.shape, f"n rows of {PULSE_COLUMNS} columns")
    signals = {}
    for member in group:
        if member in KNOWN_RUN_MEMBERS:
            continue
        if member not in SIGNALS:
            raise InputError(f"{where}/{member}", member, f"a known signal, {nearest(member, list(SIGNALS))}")
        signals[member] = _read_signal(f"{where}/{member}", group[member])
    ambient_k = float(attributes.pop("ambient_K"))
    return Run(name, ambient_k, pulses, signals, attributes)


def _read_signal(where: str, group: "h5py.Group") -> Signal:
    for field in ("t_s", "value"):
        if field not in group:
            raise InputError(f"{where}/{field}", None, "this dataset")
    if "pixel" not in group.attrs:
        raise InputError(f"{where}: pixel", None, "the index of the pixel measured")
    t_s = np.asarray(group["t_s"], dtype=np.float64)
    value = np.asarray(group["value"], dtype=np.float64)
    if t_s.shape != value.shape or t_s.ndim != 1:
        raise InputError(f"{where}/value", value.shape, f"as many values as times, {t_s.shape}")
    if np.any(np.diff(t_s) <= 0):
        raise InputError(f"{where}/t_s", "a time axis that does not rise", "increasing times")
    sigma = group.attrs.get("sigma")
    return Signal(int(group.attrs["pixel"]), t_s, value, None if sigma is None else float(sigma))
