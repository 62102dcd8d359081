"""Recorder of a session: target, plan, execution and prediction of every plan, in one HDF5 file.

A separate process writes the file: the HDF5 library holds the interpreter lock while it waits for the disk, and a
daemon that is blocked for a tenth of a second loses its board's lease. The daemon's side is a thread that feeds a pipe.
The writer reads entries on stdin, acknowledges each written one, and ends with stdin. It reserves disk space before
each entry and closes the file after it: a full disk leaves the file intact.

The file is a recording (docs/reference/recordings.md) whose runs have pulses as executed and no signals yet, with one
group /plans/ID per plan. A run begins after a pause of COLD_AFTER_S; a plan's attribute `run` names its run.
"""

import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from queue import Full, Queue
from typing import Any, BinaryIO

import numpy as np

from optodrive.core.errors import InputError
from optodrive.lab.recording.hdf5 import import_h5py
from optodrive.lab.recording.storage import FORMAT, PULSES, TABLE_COLUMNS, VERSION

QUEUE_MAX = 200
"""Maximum number of plans that wait to be written."""
CLOSE_TIMEOUT_S = 10.0
ACKNOWLEDGEMENT = b"."
Arrays = Mapping[str, np.ndarray[Any, Any]]
SessionEntry = tuple[dict[str, Any], Arrays]
"""Metadata of a plan and its arrays."""
COLD_AFTER_S = 10.0
"""Pause without pulses after which a new run begins: absorbers are cold again, although walls need minutes."""
RESERVED_BYTES = 1 << 18
"""More than HDF5 needs per plan beside its arrays."""
INSTRUMENT_NOTES = "executed pulses of a session of the driver; signals are merged in afterwards"


class SessionRecorder:
    """The daemon's side of the recorder.

    on_failure: receives one line when recording ends early
    """

    def __init__(self, path: Path, metadata: Mapping[str, Any], on_failure: Callable[[str], None]) -> None:
        """Create a new file. Raise InputError if the path exists or cannot be written."""
        import_h5py()
        if path.exists():
            raise InputError("--record-session", str(path), "a path that does not exist: no file is overwritten")
        self.path = path
        self.is_recording = True
        self._on_failure = on_failure
        self._queue: Queue[Callable[[], SessionEntry] | None] = Queue(QUEUE_MAX)
        self._writer = subprocess.Popen(
            [sys.executable, "-P", "-m", "optodrive.lab.recording.session", str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OPENBLAS_NUM_THREADS": "1"},
            start_new_session=True,  # Ctrl-C ends the daemon only: the writer ends with its pipe
        )
        try:
            self._send((dict(metadata), {}))
        except OSError:
            raise InputError("--record-session", str(path), f"a writable file ({self._read_failure()})") from None
        self._thread = threading.Thread(target=self._run_feeder, name="session recorder", daemon=True)
        self._thread.start()

    def record(self, build_entry: Callable[[], SessionEntry]) -> None:
        """Queue a plan. The recorder's thread calls build_entry. Never blocks and never raises."""
        if not self.is_recording:
            return
        try:
            self._queue.put_nowait(build_entry)
        except Full:
            self._stop(f"the disk is too slow, {QUEUE_MAX} plans are queued")

    def close(self) -> None:
        """Write the queued plans and end."""
        try:
            self._queue.put(None, timeout=1.0)
        except Full:
            return
        self._thread.join(timeout=CLOSE_TIMEOUT_S)

    def _run_feeder(self) -> None:
        try:
            while (make := self._queue.get()) is not None:
                self._send(make())
        except OSError:
            self._stop(self._read_failure())
        except Exception as error:  # a failing build_entry must not end the recording silently
            self._stop(repr(error))
        finally:
            self._close_writer()

    def _send(self, entry: SessionEntry) -> None:
        assert self._writer.stdin is not None  # noqa: S101 - as it was started
        assert self._writer.stdout is not None  # noqa: S101
        pickle.dump(entry, self._writer.stdin)
        self._writer.stdin.flush()
        if self._writer.stdout.read(1) != ACKNOWLEDGEMENT:
            raise BrokenPipeError

    def _read_failure(self) -> str:
        """Return the last line of the writer's stderr, or its exit status."""
        try:
            _, message = self._writer.communicate(timeout=CLOSE_TIMEOUT_S)
        except (subprocess.TimeoutExpired, OSError, ValueError):
            self._writer.kill()
            return "the writer process does not respond"
        return message.decode("utf-8", "replace").strip().rpartition("\n")[2] or f"status {self._writer.returncode}"

    def _close_writer(self) -> None:
        for pipe in filter(None, (self._writer.stdin, self._writer.stdout, self._writer.stderr)):
            with suppress(OSError):  # the failure has been reported already
                pipe.close()
        try:
            self._writer.wait(timeout=CLOSE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._writer.kill()

    def _stop(self, reason: str) -> None:
        was_recording, self.is_recording = self.is_recording, False
        if was_recording:
            then = "what was written stays, and the display goes on"
            self._on_failure(f"recording to {self.path} stopped: {reason}; {then}")


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
            group.attrs["started_at"] = metadata["first_pulse_at"]
            group.attrs["started_unix_s"] = metadata["first_pulse_unix_s"]
            width = len(TABLE_COLUMNS[PULSES])
            group.create_dataset(PULSES, shape=(0, width), maxshape=(None, width), chunks=(256, width), dtype="f8")
        pulses = file[f"runs/run{self._run_number}/{PULSES}"]
        pulses.resize(len(pulses) + len(executed), axis=0)
        pulses[-len(executed) :] = executed - np.array([self._run_start_s, 0.0, 0.0, 0.0])
        self._end_s = float(executed[-1, 0] + executed[-1, 1])

    def _write_plan(self, group: Any, metadata: dict[str, Any], arrays: Arrays) -> None:
        for key, value in metadata.items():
            if key in ("summary", "trains", "labels", "parameters"):  # too long for an HDF5 attribute
                group.create_dataset(key, data=value)
            elif value is not None:
                group.attrs[key] = str(value) if isinstance(value, str) else value  # h5py stores no NumPy text
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


def _read_entry(stream: BinaryIO) -> SessionEntry | None:
    """Read the next entry. Return None at the end of the stream, also in the middle of an entry."""
    try:
        entry: SessionEntry = pickle.load(stream)  # noqa: S301 - from the daemon
    except (EOFError, pickle.UnpicklingError):
        return None
    return entry


def main() -> int:
    """Write entries until the stream ends."""
    for number in (signal.SIGXFSZ, signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with its pipe, after the daemon's last entry
    first = _read_entry(sys.stdin.buffer)
    if first is None:
        return 0
    try:
        file = SessionRecordingFile(Path(sys.argv[1]), first[0])
        sys.stdout.buffer.write(ACKNOWLEDGEMENT)
        sys.stdout.buffer.flush()
        while (note := _read_entry(sys.stdin.buffer)) is not None:
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
