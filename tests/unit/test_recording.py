import h5py
import numpy as np
import pytest

from optodrive.errors import InputError
from optodrive.flow import Measurement, Run, Signal
from optodrive.recording import read_recording, write_recording


def recording():
    t_s = np.linspace(0.0, 0.1, 101)
    signals = {
        "displacement_m": Signal(17, t_s, 1e-4 * np.sin(t_s), 1e-7),
        "absorber_temperature_K": Signal(17, t_s, 293.15 + t_s),
    }
    pulses = np.array([[0.0, 0.02, 2.45, 17.0], [0.05, 0.02, 1.0, 17.0]])
    return Measurement((Run("a", 293.15, pulses, signals, {"bridge_width_m": 4e-4, "sample": "x"}),))


def test_what_is_written_is_read_again(tmp_path):
    path = tmp_path / "r.h5"
    write_recording(path, recording())
    (run,), (original,) = read_recording(path).runs, recording().runs
    assert (run.name, run.ambient_k) == (original.name, original.ambient_k)
    assert np.array_equal(run.pulses, original.pulses)
    assert run.attributes["sample"] == "x"
    assert run.signals.keys() == original.signals.keys()
    for name, signal in run.signals.items():
        assert np.array_equal(signal.value, original.signals[name].value)
        assert signal.sigma == original.signals[name].sigma
        assert signal.pixel == 17


def test_the_file_is_laid_out_as_the_format_says(tmp_path):
    path = tmp_path / "r.h5"
    write_recording(path, recording())
    with h5py.File(path) as file:
        assert file.attrs["format"] == "optotactile-recording"
        assert file.attrs["version"] == 1
        run = file["runs/a"]
        assert run.attrs["ambient_K"] == 293.15
        assert run["pulses"].shape == (2, 4)
        assert run["displacement_m/t_s"].dtype == np.float64
        assert run["displacement_m"].attrs["pixel"] == 17
        assert "sigma" not in run["absorber_temperature_K"].attrs


DAMAGE = {
    "format": (lambda f: f.attrs.__setitem__("format", "other"), "format"),
    "version": (lambda f: f.attrs.__setitem__("version", 2), "version"),
    "no runs": (lambda f: f.__delitem__("runs"), "/runs"),
    "no ambient": (lambda f: f["runs/a"].attrs.__delitem__("ambient_K"), "ambient_K"),
    "no pulses": (lambda f: f["runs/a"].__delitem__("pulses"), "pulses"),
    "unknown signal": (lambda f: f["runs/a"].move("displacement_m", "displacement_mm"), "nearest is 'displacement_m'"),
    "no values": (lambda f: f["runs/a/displacement_m"].__delitem__("value"), "value"),
    "no pixel": (lambda f: f["runs/a/displacement_m"].attrs.__delitem__("pixel"), "pixel"),
    "time backwards": (lambda f: f["runs/a/displacement_m/t_s"].__setitem__(5, 9.0), "does not rise"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_files_are_refused_by_place(tmp_path, kind):
    damage, naming = DAMAGE[kind]
    path = tmp_path / "r.h5"
    write_recording(path, recording())
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(InputError, match=naming):
        read_recording(path)


def test_no_hdf5_and_truncated_files_are_refused(tmp_path):
    path = tmp_path / "r.h5"
    with pytest.raises(InputError):
        read_recording(path)
    path.write_bytes(b"no HDF5")
    with pytest.raises(InputError, match="readable HDF5"):
        read_recording(path)
    write_recording(path, recording())
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(InputError):
        read_recording(path)


def test_nothing_is_left_where_writing_fails(tmp_path):
    with pytest.raises(InputError, match="can be written"):
        write_recording(tmp_path / "nowhere" / "r.h5", recording())
    target = tmp_path / "folder"
    target.mkdir()
    with pytest.raises(InputError):
        write_recording(target, recording())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder"]
