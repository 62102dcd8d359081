"""Recordings of measured data, format "optotactile-recording", version 1: one HDF5 file, or a folder of CSV files."""

from optodrive.recording.form import FORMAT, SIGNALS, VERSION
from optodrive.recording.index import RecordingIndex, RunIndex, SignalIndex
from optodrive.recording.pixels import DisplayRuns, PixelRuns
from optodrive.recording.read import read_recording, read_runs
from optodrive.recording.write import convert_recording, write_recording

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
