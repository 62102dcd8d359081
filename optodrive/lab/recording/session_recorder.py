"""Recorder of a session: target, plan, execution and prediction of every plan, in one HDF5 file.

A separate process writes the file: the HDF5 library holds the interpreter lock while it waits for the disk, and a
daemon that is blocked for a tenth of a second loses its board's lease. The daemon's side is a thread that feeds a pipe.

The file is a recording (docs/reference/recordings.md) whose runs have pulses as executed and no signals yet, with one
group /plans/ID per plan. A run begins after a pause of COLD_AFTER_S; a plan's attribute `run` names its run.
"""

import io
import json
import os
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from queue import Full, Queue
from typing import Any

import numpy as np

from optodrive.core.errors import InputError
from optodrive.lab.recording.hdf5 import import_h5py

QUEUE_MAX = 200
"""Maximum number of plans that wait to be written."""
CLOSE_TIMEOUT_S = 10.0
LENGTH_PREFIX = struct.Struct("<Q")
ACKNOWLEDGEMENT = b"."
Arrays = Mapping[str, np.ndarray[Any, Any]]
SessionEntry = tuple[dict[str, Any], Arrays]
"""Metadata of a plan and its arrays."""


def encode_entry(metadata: Mapping[str, Any], arrays: Arrays) -> bytes:
    """Encode an entry for the writer process."""
    body = io.BytesIO()
    text = np.frombuffer(json.dumps(metadata).encode(), dtype=np.uint8)
    np.savez(body, about_=text, **arrays)  # type: ignore[arg-type]
    return LENGTH_PREFIX.pack(body.tell()) + body.getvalue()


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
            [sys.executable, "-P", "-m", "optodrive.lab.recording.session_writer", str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OPENBLAS_NUM_THREADS": "1"},
            start_new_session=True,  # Ctrl-C ends the daemon only: the writer ends with its pipe
        )
        try:
            self._send(encode_entry(metadata, {}))
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
                self._send(encode_entry(*make()))
        except OSError:
            self._stop(self._read_failure())
        except Exception as error:  # a failing build_entry must not end the recording silently
            self._stop(repr(error))
        finally:
            self._close_writer()

    def _send(self, packed: bytes) -> None:
        assert self._writer.stdin is not None  # noqa: S101 - as it was started
        assert self._writer.stdout is not None  # noqa: S101
        self._writer.stdin.write(packed)
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
        for pipe in (self._writer.stdin, self._writer.stdout, self._writer.stderr):
            if pipe is not None:
                try:
                    pipe.close()
                except OSError:
                    continue  # the failure has been reported already
        try:
            self._writer.wait(timeout=CLOSE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._writer.kill()

    def _stop(self, reason: str) -> None:
        was_recording, self.is_recording = self.is_recording, False
        if was_recording:
            self._on_failure(
                f"recording to {self.path} stopped: {reason}; what was written stays, and the display goes on"
            )
