"""Indexing a recording without its samples, and reading selected runs."""

import h5py
import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording import (
    RecordingIndex,
    SignalIndex,
    csv_folder,
    hdf5,
    read_recording,
    read_runs,
    write_recording,
)
from recording_samples import assert_same, recording


@pytest.fixture(params=["r.h5", "folder"])
def path(request, tmp_path):
    path = tmp_path / request.param
    write_recording(path, recording(), "a camera")
    return path


def test_what_an_index_tells(path):
    index = RecordingIndex.open(path)
    assert (index.path, index.instrument_notes) == (path, "a camera")
    first, second = index.runs
    assert (first.name, first.ambient_k, first.pulse_count, first.pulsed_pixels) == ("run2", 293.15, 2, (17, 18))
    assert first.attributes == recording().runs[0].attributes
    assert first.signals == {
        "absorber_temperature_K": SignalIndex(17, 101, None),
        "displacement_m": SignalIndex(17, 101, 1e-7 / 3),
    }
    assert (first.measured_pixels, first.has_commands) == ((17,), False)
    assert (second.measured_pixels, second.has_commands, second.pulse_count, second.pulsed_pixels) == ((), True, 0, ())
    assert index.group_runs_by_pixel() == {17: ("run2",)}


def test_samples_are_not_read(path, monkeypatch):
    def fail(*_):
        raise AssertionError("samples were read")

    monkeypatch.setattr(hdf5.Hdf5Tree, "read_samples", fail)
    monkeypatch.setattr(csv_folder.CsvTree, "read_samples", fail)
    assert len(RecordingIndex.open(path).runs) == 2


def test_only_the_runs_asked_for_are_read(path):
    both = read_recording(path)
    assert_same(read_runs(path, ["run10", "run2"]), Measurement(both.runs[::-1]))
    assert_same(RecordingIndex.open(path).read(["run10"]), Measurement(both.runs[1:]))
    with pytest.raises(InputError, match="nearest is 'run10'"):
        read_runs(path, ["run1O"])


def test_damage_in_one_run_leaves_the_others_readable(tmp_path):
    path = tmp_path / "r.h5"
    write_recording(path, recording())
    with h5py.File(path, "r+") as file:
        file["runs/run2/displacement_m/t_s"][5] = np.nan
    with pytest.raises(InputError, match=r"/runs/run2/displacement_m/t_s\[5\]"):
        read_recording(path)
    assert len(read_runs(path, ["run10"]).runs) == 1


def test_pixels_of_a_whole_display_are_listed_in_order(tmp_path):
    t_s = np.arange(6.0)
    runs = [
        Run(f"p{pixel}-{k}", 293.0, np.array([[0.0, 1.0, 1.0, pixel]]), {"force_N": Signal(pixel, t_s, t_s)})
        for k in range(2)
        for pixel in range(11, -1, -1)
    ]
    write_recording(tmp_path / "r.h5", Measurement(tuple(runs)))
    by_pixel = RecordingIndex.open(tmp_path / "r.h5").group_runs_by_pixel()
    assert list(by_pixel) == list(range(12))
    assert by_pixel[10] == ("p10-0", "p10-1")


def test_an_index_refuses_what_shows_without_samples(tmp_path):
    path = tmp_path / "r.h5"
    write_recording(path, recording())
    with h5py.File(path, "r+") as file:
        file["runs/run2/pulses"][0, 1] = -1.0
    with pytest.raises(InputError, match=r"/runs/run2/pulses: width_s\[0\]"):
        RecordingIndex.open(path)
