"""Writer process of a session's file: reads entries on stdin, acknowledges each written one, and ends with stdin.

Disk space is reserved before each entry, and the file is closed after it: a full disk leaves the file intact.
"""

import io
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from optodrive.lab.recording.hdf5 import import_h5py
from optodrive.lab.recording.session_recorder import ACKNOWLEDGEMENT, LENGTH_PREFIX, Arrays
from optodrive.lab.recording.storage import FORMAT, PULSES, TABLE_COLUMNS, VERSION

SESSION_VERSION = 2
COLD_AFTER_S = 10.0
"""Pause without pulses after which a new run begins: absorbers are cold again, although walls need minutes."""
RESERVED_BYTES = 1 << 18
"""More than HDF5 needs per plan beside its arrays."""
INSTRUMENT_NOTES = "executed pulses of a session of the driver; signals are merged in afterwards"


class SessionRecordingFile:
    """A session's file, open only during a write."""

    def __init__(self, path: Path, metadata: dict[str, Any]) -> None:
        """Create the file. Raise OSError if it cannot be written."""
        self._path = path
        self._metadata = metadata
        self._run_number = 0
        self._run_start_s = self._end_s = 0.0
        path.touch(exist_ok=False)
        reserve_disk_space(path, RESERVED_BYTES)
        with import_h5py().File(path, "w") as file:
            file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
            file.attrs["instrument_notes"] = INSTRUMENT_NOTES
            file.attrs["session_version"] = SESSION_VERSION
            file.attrs["display"], file.attrs["optodrive"] = metadata["display"], metadata["optodrive"]
            file.create_group("runs")
            file.create_group("plans").create_dataset("config", data=metadata["config"])

    def add_plan(self, metadata: dict[str, Any], arrays: Arrays) -> None:
        """Write a plan. Raise OSError if the disk is full and then leave the file unchanged."""
        reserve_disk_space(self._path, 2 * sum(array.nbytes for array in arrays.values()) + RESERVED_BYTES)
        with import_h5py().File(self._path, "r+") as file:
            executed = arrays.get("executed")
            if executed is not None and len(executed):
                self._append_to_run(file, metadata, executed)
                metadata["run"], metadata["run_start_s"] = f"run{self._run_number}", self._run_start_s
            self._write_plan(file["plans"].create_group(metadata["plan"]), metadata, arrays)

    def _append_to_run(self, file: Any, metadata: dict[str, Any], executed: np.ndarray[Any, Any]) -> None:
        """Append pulses to the last run, or to a new run after a pause or a reset of the board's clock."""
        first_s = float(executed[0, 0])
        starts_run = first_s - self._end_s >= COLD_AFTER_S or first_s < self._run_start_s
        if self._run_number == 0 or starts_run:
            self._run_number += 1
            self._run_start_s = first_s
            group = file["runs"].create_group(f"run{self._run_number}")
            group.attrs["ambient_K"] = self._metadata["ambient_K"]
            group.attrs["bridge_width_m"] = self._metadata["bridge_width_m"]
            group.attrs["sample"] = self._metadata["display"]
            group.attrs["started_at"], group.attrs["started_unix_s"] = (
                metadata["first_pulse_at"],
                metadata["first_pulse_unix_s"],
            )
            columns = len(TABLE_COLUMNS[PULSES])
            group.create_dataset(
                PULSES, shape=(0, columns), maxshape=(None, columns), chunks=(256, columns), dtype="f8"
            )
        pulses = file[f"runs/run{self._run_number}/{PULSES}"]
        pulses.resize(len(pulses) + len(executed), axis=0)
        pulses[-len(executed) :] = executed - np.array([self._run_start_s, 0.0, 0.0, 0.0])
        self._end_s = float(executed[-1, 0] + executed[-1, 1])

    def _write_plan(self, group: Any, metadata: dict[str, Any], arrays: Arrays) -> None:
        for key, value in metadata.items():
            if key in ("summary", "trains", "labels", "parameters"):  # too long for an HDF5 attribute
                group.create_dataset(key, data=value)
            elif value is not None:
                group.attrs[key] = value
        for name, array in arrays.items():
            group.create_dataset(name, data=array, compression="gzip" if array.size > 1000 else None)


def reserve_disk_space(path: Path, size: int) -> None:
    """Allocate disk space beyond the end of the file, released on close. Raise OSError if the disk is full."""
    with path.open("r+b") as file:
        end = file.seek(0, os.SEEK_END)
        try:
            os.posix_fallocate(file.fileno(), end, size)
        except OSError:
            file.truncate(end)
            raise


def read_entry(stream: BinaryIO) -> tuple[dict[str, Any], dict[str, np.ndarray[Any, Any]]] | None:
    """Read the next entry. Return None at the end of the stream, also in the middle of an entry."""
    head = stream.read(LENGTH_PREFIX.size)
    if len(head) < LENGTH_PREFIX.size:
        return None
    (length,) = LENGTH_PREFIX.unpack(head)
    body = stream.read(length)
    if len(body) < length:
        return None
    with np.load(io.BytesIO(body), allow_pickle=False) as arrays:
        entry_arrays = {name: arrays[name] for name in arrays.files}
    metadata: dict[str, Any] = json.loads(entry_arrays.pop("about_").tobytes())
    return metadata, entry_arrays


def main() -> int:
    """Write entries until the stream ends."""
    for number in (signal.SIGXFSZ, signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with its pipe, after the daemon's last entry
    first = read_entry(sys.stdin.buffer)
    if first is None:
        return 0
    try:
        file = SessionRecordingFile(Path(sys.argv[1]), first[0])
        sys.stdout.buffer.write(ACKNOWLEDGEMENT)
        sys.stdout.buffer.flush()
        while (note := read_entry(sys.stdin.buffer)) is not None:
            file.add_plan(*note)
            sys.stdout.buffer.write(ACKNOWLEDGEMENT)
            sys.stdout.buffer.flush()
    except BrokenPipeError:
        return 0  # the daemon is gone; all complete entries are written
    except OSError as error:
        sys.stderr.write(f"{error.strerror or error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
