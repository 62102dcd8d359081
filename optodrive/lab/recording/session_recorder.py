"""A session as a recording: what was asked, planned, executed and reckoned, plan by plan, in one HDF5 file.

Written by a process of its own: the HDF5 library holds the interpreter while it waits for the disk, and a daemon that
stands still for a tenth of a second loses its board's lease. The daemon's side is a thread that feeds a pipe.

file: a recording (docs/recordings.md) whose runs have pulses as executed and no signals yet, and beside them
/plans/ID. A run begins where the display had been dark for REST_S; a plan's attribute `run` names its own.
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
from optodrive.lab.recording.hdf5 import h5py_module

WAITING_MAX = 200
"""Plans that may wait for the disk."""
CLOSING_S = 10.0
LENGTH = struct.Struct("<Q")
WRITTEN = b"."
Arrays = Mapping[str, np.ndarray[Any, Any]]
Note = tuple[dict[str, Any], Arrays]
"""What is known of a plan in plain words and numbers, and its arrays."""


def pack(about: Mapping[str, Any], arrays: Arrays) -> bytes:
    """A note as the writer takes it."""
    body = io.BytesIO()
    text = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
    np.savez(body, about_=text, **arrays)  # type: ignore[arg-type]
    return LENGTH.pack(body.tell()) + body.getvalue()


class SessionRecorder:
    """The daemon's side. say: gets the one line when recording ends early; `note` never waits and never raises."""

    def __init__(self, path: Path, about: Mapping[str, Any], say: Callable[[str], None]) -> None:
        """Begin a new file; InputError where there is one already, or it cannot be written."""
        h5py_module()
        if path.exists():
            raise InputError("--record-session", str(path), "a name that is free: nothing is overwritten")
        self.path = path
        self.recording = True
        self._say = say
        self._waiting: Queue[Callable[[], Note] | None] = Queue(WAITING_MAX)
        self._writer = subprocess.Popen(
            [sys.executable, "-P", "-m", "optodrive.lab.recording.session_writer", str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OPENBLAS_NUM_THREADS": "1"},
            start_new_session=True,  # a Ctrl-C meant for the daemon is not meant for it: it ends when its pipe does
        )
        try:
            self._hand_over(pack(about, {}))
        except OSError:
            raise InputError("--record-session", str(path), f"a file that can be written ({self._why()})") from None
        self._thread = threading.Thread(target=self._feed, name="session recorder", daemon=True)
        self._thread.start()

    def note(self, make: Callable[[], Note]) -> None:
        """Have a plan written; what is to be written is made in the recorder's own thread."""
        if not self.recording:
            return
        try:
            self._waiting.put_nowait(make)
        except Full:
            self._stop(f"the disk is too slow, {WAITING_MAX} plans wait")

    def close(self) -> None:
        """Write what waits, and end."""
        try:
            self._waiting.put(None, timeout=1.0)
        except Full:
            return
        self._thread.join(timeout=CLOSING_S)

    def _feed(self) -> None:
        try:
            while (make := self._waiting.get()) is not None:
                self._hand_over(pack(*make()))
        except OSError:
            self._stop(self._why())
        except Exception as error:  # a note that cannot be made must not end the recording in silence
            self._stop(repr(error))
        finally:
            self._end_writer()

    def _hand_over(self, packed: bytes) -> None:
        assert self._writer.stdin is not None  # noqa: S101 - as it was started
        assert self._writer.stdout is not None  # noqa: S101
        self._writer.stdin.write(packed)
        self._writer.stdin.flush()
        if self._writer.stdout.read(1) != WRITTEN:
            raise BrokenPipeError

    def _why(self) -> str:
        """The writer's own line; it has ended, or is about to."""
        try:
            _, told = self._writer.communicate(timeout=CLOSING_S)
        except (subprocess.TimeoutExpired, OSError, ValueError):
            self._writer.kill()
            return "its writer hangs"
        return told.decode("utf-8", "replace").strip().rpartition("\n")[2] or f"status {self._writer.returncode}"

    def _end_writer(self) -> None:
        for pipe in (self._writer.stdin, self._writer.stdout, self._writer.stderr):
            if pipe is not None:
                try:
                    pipe.close()
                except OSError:
                    continue  # what could not be written is what was told
        try:
            self._writer.wait(timeout=CLOSING_S)
        except subprocess.TimeoutExpired:
            self._writer.kill()

    def _stop(self, why: str) -> None:
        was_recording, self.recording = self.recording, False
        if was_recording:
            self._say(f"recording to {self.path} stopped: {why}; what was written stays, and the display goes on")
