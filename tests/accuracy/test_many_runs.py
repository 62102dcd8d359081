"""A recording of many runs is read in full: the limit on processor time of the first reading grows with them."""

from dataclasses import replace

import pytest

from labs import lab
from optodrive.core.types.measurements import Measurement
from optodrive.lab.recording import hdf5, write_recording


@pytest.mark.slow
def test_a_sound_file_of_many_runs_may_take_its_time(tmp_path, monkeypatch):
    monkeypatch.setattr(hdf5, "CPU_LIMIT_S", 1)
    (run,) = lab(1, {}, groups=("weak",), repeats=1).runs
    runs = tuple(replace(run, name=f"run-{number}") for number in range(900))
    write_recording(tmp_path / "many.h5", Measurement(runs))
    hdf5.probe_in_sandbox(tmp_path / "many.h5")
