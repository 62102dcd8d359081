"""Recordings of measured data in format "optotactile-recording", version 1: one HDF5 file or a folder of CSV files."""

from optodrive.lab.recording.reader import (
    DisplayRuns,
    PixelRuns,
    RecordingIndex,
    RunIndex,
    SignalIndex,
    read_recording,
    read_runs,
)
from optodrive.lab.recording.storage import FORMAT, SIGNALS, VERSION
from optodrive.lab.recording.writer import convert_recording, write_recording

__all__ = [
    "FORMAT",
    "SIGNALS",
    "VERSION",
    "DisplayRuns",
    "PixelRuns",
    "RecordingIndex",
    "RunIndex",
    "SignalIndex",
    "convert_recording",
    "read_recording",
    "read_runs",
    "write_recording",
]
