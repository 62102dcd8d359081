"""Recordings as one HDF5 file: round trips, and every refusal with its place."""

import contextlib
import os

import h5py
import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording import convert_recording, hdf5, read_recording, reader, write_recording
from optodrive.lab.recording.hdf5 import Hdf5Tree
from optodrive.lab.recording.storage import natural_sort_key
from optodrive.lab.recording.trials import read_trials
from recording_samples import T_S, assert_same, recording, sorted_attributes


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "r.h5"
    write_recording(path, recording(), "a camera")
    return path


def refusal(path):
    with pytest.raises(InputError) as caught:
        read_recording(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(path))
    assert caught.value.exit_status == 2
    return message.removeprefix(str(path))


def test_what_is_written_is_read_again(path):
    assert_same(read_recording(path), sorted_attributes(recording()))


def test_arrays_that_were_read_cannot_be_changed(path):
    run = read_recording(path).runs[0]
    for array in (run.pulses, run.signals["displacement_m"].value):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_the_file_is_laid_out_as_the_format_says(path):
    with h5py.File(path) as file:
        assert file.attrs["format"] == "optotactile-recording"
        assert file.attrs["version"] == 1
        assert file.attrs["instrument_notes"] == "a camera"
        run = file["runs/run2"]
        assert run.attrs["ambient_K"] == 293.15
        assert run["pulses"].shape == (2, 4)
        assert run["displacement_m/t_s"].dtype == np.float64
        assert run["displacement_m"].attrs["pixel"] == 17
        assert "sigma" not in run["absorber_temperature_K"].attrs
        assert "commands" not in run
        assert file["runs/run10/commands"].shape == (11, 3)


def test_both_forms_carry_the_same_there_and_back(path, tmp_path):
    convert_recording(path, tmp_path / "folder")
    convert_recording(tmp_path / "folder", tmp_path / "again.HDF5")
    assert_same(read_recording(tmp_path / "again.HDF5"), read_recording(path))
    with h5py.File(tmp_path / "again.HDF5") as file:
        assert file.attrs["instrument_notes"] == "a camera"


def test_runs_come_in_their_natural_order(tmp_path):
    one = recording().runs[0]
    names = ["run10", "b", "run2", "run02", "run1a", "9", "run1"]
    renamed = [Run(name, one.ambient_k, one.pulses, one.signals) for name in names]
    write_recording(tmp_path / "r.h5", Measurement(tuple(renamed)))
    read = [run.name for run in read_recording(tmp_path / "r.h5").runs]
    assert read == sorted(names, key=natural_sort_key) == ["9", "b", "run1", "run1a", "run02", "run2", "run10"]


def test_attributes_of_any_tool_become_text_and_numbers(path):
    with h5py.File(path, "r+") as file:
        attrs = file["runs/run2"].attrs
        attrs["bytes"] = np.bytes_("Muster")
        attrs["latin"] = np.bytes_(b"\xb5m")
        attrs["of one"] = np.array([[2.5]])
        attrs["text of one"] = np.array([b"x"])
        attrs["small"] = np.float32(0.5)
        attrs["yes"] = True
        attrs["several"] = np.arange(3.0)
        attrs["nothing"] = h5py.Empty("f8")
        attrs["complex"] = 1j
        attrs["record"] = np.array((1, 2.0), dtype=[("a", "i4"), ("b", "f8")])
        attrs["opaque"] = np.void(b"\0\1")
        attrs["reference"] = file["runs/run2"].ref
        attrs["ambient_K"] = np.array([300], dtype=">i2")
        file["runs/run2/displacement_m"].attrs["pixel"] = np.array([17.0])
        file.attrs["version"] = np.float64(1.0)
    run = read_recording(path).runs[0]
    kept = {"bytes": "Muster", "latin": "\ufffdm", "of one": 2.5, "text of one": "x", "small": 0.5, "yes": "true"}
    assert {key: run.attributes[key] for key in kept} == kept
    assert run.attributes.keys() == kept.keys() | recording().runs[0].attributes.keys()
    assert run.ambient_k == 300.0
    assert run.signals["displacement_m"].pixel == 17


def test_other_types_of_numbers_are_read_as_float64(path):
    with h5py.File(path, "r+") as file:
        run = file["runs/run2"]
        replace(run, "pulses", np.array([[0, 1, 2, 17]], dtype=">i4"), compression="gzip")
        replace(run["displacement_m"], "value", np.arange(101, dtype=np.float32))
    run = read_recording(path).runs[0]
    assert run.pulses.dtype == run.signals["displacement_m"].value.dtype == np.float64
    assert run.pulses.tolist() == [[0.0, 1.0, 2.0, 17.0]]


def test_extra_members_are_ignored_where_they_name_nothing(path):
    with h5py.File(path, "r+") as file:
        file["notes"] = np.arange(3)
        file["runs/run2/displacement_m/quality"] = np.arange(5)
        file["runs/run2/displacement_m"].attrs["unit"] = "m"
    assert len(read_recording(path).runs) == 2


def test_sigma_zero_states_no_noise_and_mirrors_need_no_pixel(path):
    with h5py.File(path, "r+") as file:
        file["runs/run2/displacement_m"].attrs["sigma"] = 0.0
        del file["runs/run10/mirror_x_rad"].attrs["pixel"]
    first, second = read_recording(path).runs
    assert first.signals["displacement_m"].sigma is None
    assert second.signals["mirror_x_rad"].pixel == 0


def test_pulses_may_abut_within_rounding(path):
    rows = np.array([[0.3, 0.1, 1.0, 1], [0.1, 0.1, 1.0, 2], [0.2 - 1e-10, 0.1, 1.0, 3]])
    with h5py.File(path, "r+") as file:
        replace(file["runs/run2"], "pulses", rows)
    assert np.array_equal(read_recording(path).runs[0].pulses, rows)


def replace(group, name, data, **options):
    del group[name]
    group.create_dataset(name, data=data, **options)


def setting(place, name, value):
    return lambda file: file[place].attrs.__setitem__(name, value)


def unsetting(place, name):
    return lambda file: file[place].attrs.__delitem__(name)


def data(place, name, values):
    return lambda file: replace(file[place], name, values)


def entry(place, index, value):
    return lambda file: file[place].__setitem__(index, value)


def deleting(place):
    return lambda file: file.__delitem__(place)


def every(*damages):
    return lambda file: [damage(file) for damage in damages]


RUN, HEIGHT, MIRROR = "runs/run2", "runs/run2/displacement_m", "runs/run10/mirror_x_rad"


def compound(file):
    replace(file[RUN], "pulses", np.zeros(2, dtype=[("a", "f8"), ("b", "f8")]))


def huge(file):
    del file[HEIGHT]
    group = file.create_group(HEIGHT)
    group.attrs["pixel"] = 17
    for name in ("t_s", "value"):
        group.create_dataset(name, shape=(2**40,), chunks=(1024,), dtype="f8")


def few(file):
    del file["runs/run10"]
    del file[f"{RUN}/absorber_temperature_K"]
    file[f"{HEIGHT}/value"][5:] = np.nan  # one of the first five is missing as well


def linked(file):
    del file[f"{RUN}/pulses"]
    file[f"{RUN}/pulses"] = h5py.ExternalLink("other.h5", "/pulses")


def stored_elsewhere(file):
    del file[f"{RUN}/pulses"]
    file[RUN].create_dataset("pulses", shape=(2, 4), dtype="f8", external=[("/etc/passwd", 0, 64)])


REFUSALS = {
    "format": (setting("/", "format", "other"), ["format", "'other'", "'optotactile-recording'"]),
    "no format": (unsetting("/", "format"), ["format", "'optotactile-recording'"]),
    "version": (setting("/", "version", 2), ["version", "2", "1, the one this release reads"]),
    "version of words": (setting("/", "version", "1"), ["version", "'1'"]),
    "no version": (unsetting("/", "version"), ["version"]),
    "no runs": (deleting("runs"), ["/runs", "a group"]),
    "runs empty": (every(deleting("runs/run2"), deleting("runs/run10")), ["/runs", "no runs", "at least one"]),
    "run a dataset": (lambda f: f["runs"].create_dataset("x", data=[1.0]), ["/runs/x", "a dataset", "a group"]),
    "run empty": (lambda f: f.create_group("runs/x").attrs.__setitem__("ambient_K", 293.0), ["/runs/x/pulses"]),
    "run without signals": (
        every(deleting(HEIGHT), deleting(f"{RUN}/absorber_temperature_K")),
        ["/runs/run2", "without signals", "displacement_m"],
    ),
    "run named so": (lambda f: f.move(RUN, "runs/a\nb"), ["/runs", "'a\\nb'", "printable"]),
    "run hidden": (lambda f: f.move(RUN, "runs/.x"), ["/runs", "'.x'", "leading '.'"]),
    "no ambient": (unsetting(RUN, "ambient_K"), ["/runs/run2: ambient_K", "in K"]),
    "ambient in degrees": (
        every(unsetting(RUN, "ambient_K"), setting(RUN, "ambient_C", 20.0)),
        ["/runs/run2: ambient_K", "'ambient_C'"],
    ),
    "ambient cold": (setting(RUN, "ambient_K", 20.0), ["ambient_K", "20.0", "between 150 and 600 K"]),
    "ambient hot": (setting(RUN, "ambient_K", 601.0), ["ambient_K", "601.0"]),
    "ambient NaN": (setting(RUN, "ambient_K", np.nan), ["ambient_K", "nan"]),
    "ambient text": (setting(RUN, "ambient_K", "293 K"), ["ambient_K", "'293 K'"]),
    "ambient many": (setting(RUN, "ambient_K", [293.0, 294.0]), ["ambient_K"]),
    "no pulses": (deleting(f"{RUN}/pulses"), ["/runs/run2/pulses", "start_s, width_s, power_W, pixel"]),
    "pulses of three": (data(RUN, "pulses", np.zeros((2, 3))), ["/runs/run2/pulses", "(2, 3)", "4 columns"]),
    "pulses flat": (data(RUN, "pulses", np.zeros(4)), ["/runs/run2/pulses", "(4,)"]),
    "pulses scalar": (data(RUN, "pulses", 1.0), ["/runs/run2/pulses", "()"]),
    "pulses nothing": (data(RUN, "pulses", h5py.Empty("f8")), ["/runs/run2/pulses", "nothing"]),
    "pulses compound": (compound, ["/runs/run2/pulses", "type", "dataset of numbers"]),
    "pulses text": (data(RUN, "pulses", np.array([[b"a"] * 4])), ["/runs/run2/pulses", "|S1"]),
    "pulses objects": (data(RUN, "pulses", [["a"] * 4]), ["/runs/run2/pulses", "object"]),
    "pulses complex": (data(RUN, "pulses", np.zeros((1, 4), complex)), ["/runs/run2/pulses", "complex128"]),
    "pulses a group": (
        every(deleting(f"{RUN}/pulses"), lambda f: f.create_group(f"{RUN}/pulses")),
        ["/runs/run2/pulses", "a group", "dataset"],
    ),
    "pulses elsewhere": (linked, ["/runs/run2/pulses", "a link", "stored in this file"]),
    "pulses of another file": (stored_elsewhere, ["/runs/run2/pulses", "other files"]),
    "pulse NaN": (entry(f"{RUN}/pulses", (1, 0), np.nan), ["pulses: start_s[1]", "nan", "finite"]),
    "pulse infinite": (entry(f"{RUN}/pulses", (0, 2), np.inf), ["pulses: power_W[0]", "inf", "finite"]),
    "pulse of width below 0": (entry(f"{RUN}/pulses", (1, 1), -0.01), ["pulses: width_s[1]", "-0.01"]),
    "pulse of power below 0": (entry(f"{RUN}/pulses", (1, 2), -2.0), ["pulses: power_W[1]", "-2.0"]),
    "pulse at half a pixel": (entry(f"{RUN}/pulses", (1, 3), 17.5), ["pulses: pixel[1]", "17.5", "whole"]),
    "pulse at pixel -1": (entry(f"{RUN}/pulses", (1, 3), -1), ["pulses: pixel[1]", "-1.0"]),
    "pulse at pixel 1e300": (entry(f"{RUN}/pulses", (1, 3), 1e300), ["pulses: pixel[1]", "1e+300"]),
    "pulses overlap": (entry(f"{RUN}/pulses", (1, 0), 0.019), ["pulses[1]: start_s", "0.019", "0.02", "the beam"]),
    "pulses overlap out of order": (
        data(RUN, "pulses", np.array([[1.0, 0.1, 1, 1], [0.0, 5.0, 1, 1], [0.5, 0.1, 1, 1]])),
        ["pulses[2]: start_s", "0.5", "5.0"],
    ),
    "unknown unit": (
        lambda f: f.move(f"{RUN}/absorber_temperature_K", f"{RUN}/absorber_temperature_C"),
        ["/runs/run2/absorber_temperature_C", "unknown", "nearest is 'absorber_temperature_K'"],
    ),
    "unknown signal": (lambda f: f.move(HEIGHT, f"{RUN}/height"), ["/runs/run2/height", "force_N"]),
    "unknown, of two lines": (lambda f: f.move(HEIGHT, f"{RUN}/a\nb"), ["/runs/run2/'a\\nb'"]),
    "unit beside": (setting(HEIGHT, "units", "mm"), ["/runs/run2/displacement_m: units", "'mm'", "'m'"]),
    "signal a dataset": (
        every(deleting(HEIGHT), lambda f: f.create_dataset(HEIGHT, data=[1.0])),
        ["/runs/run2/displacement_m", "a dataset", "a group"],
    ),
    "no values": (deleting(f"{HEIGHT}/value"), ["/runs/run2/displacement_m/value", "dataset"]),
    "no times": (deleting(f"{HEIGHT}/t_s"), ["/runs/run2/displacement_m/t_s", "dataset"]),
    "fewer values": (data(HEIGHT, "value", np.zeros(100)), ["displacement_m/value", "(100,)", "(101,)"]),
    "values text": (data(HEIGHT, "value", np.array([b"1"] * 101)), ["displacement_m/value", "|S1", "numbers"]),
    "times of two rows": (data(HEIGHT, "t_s", np.zeros((101, 1))), ["displacement_m/t_s", "(101, 1)"]),
    "samples none": (
        every(data(HEIGHT, "t_s", np.zeros(0)), data(HEIGHT, "value", np.zeros(0))),
        ["/runs/run2/displacement_m", "no samples"],
    ),
    "samples too many": (huge, ["displacement_m/t_s", "1099511627776 numbers", "at most"]),
    "samples too few": (few, ["/runs", "4 finite samples", "at least 6", "parameters"]),
    "no pixel": (unsetting(HEIGHT, "pixel"), ["/runs/run2/displacement_m: pixel", "index"]),
    "pixel half": (setting(HEIGHT, "pixel", 1.5), ["displacement_m: pixel", "1.5", "whole"]),
    "pixel below 0": (setting(HEIGHT, "pixel", -1), ["displacement_m: pixel", "-1"]),
    "pixel NaN": (setting(HEIGHT, "pixel", np.nan), ["displacement_m: pixel", "nan"]),
    "pixel text": (setting(HEIGHT, "pixel", "17"), ["displacement_m: pixel", "'17'"]),
    "pixel true": (setting(HEIGHT, "pixel", True), ["displacement_m: pixel", "'true'"]),
    "sigma true": (setting(HEIGHT, "sigma", True), ["displacement_m: sigma", "'true'"]),
    "version true": (setting("/", "version", True), ["version", "'true'", "1, the one this release reads"]),
    "pulses true": (data(RUN, "pulses", np.ones((1, 4), bool)), ["/runs/run2/pulses", "bool", "numbers"]),
    "sigma below 0": (setting(HEIGHT, "sigma", -1.0), ["displacement_m: sigma", "-1.0", "positive"]),
    "sigma infinite": (setting(HEIGHT, "sigma", np.inf), ["displacement_m: sigma", "inf"]),
    "sigma text": (setting(HEIGHT, "sigma", "small"), ["displacement_m: sigma", "'small'"]),
    "time backwards": (entry(f"{HEIGHT}/t_s", 5, 9.0), ["displacement_m/t_s[6]", "0.006", "increasing", "9.0"]),
    "time repeats": (entry(f"{HEIGHT}/t_s", 5, T_S[4]), ["displacement_m/t_s[5]", "increasing"]),
    "time NaN": (entry(f"{HEIGHT}/t_s", 5, np.nan), ["displacement_m/t_s[5]", "nan", "finite"]),
    "time infinite": (entry(f"{HEIGHT}/t_s", 100, np.inf), ["displacement_m/t_s[100]", "inf", "finite"]),
    "value infinite": (entry(f"{HEIGHT}/value", 7, -np.inf), ["displacement_m/value[7]", "-inf", "NaN where"]),
    "values all NaN": (entry(f"{HEIGHT}/value", slice(None), np.nan), ["displacement_m/value", "101 times NaN"]),
    "mirror without commands": (deleting("runs/run10/commands"), ["/runs/run10/commands", "t_s, x_rad, y_rad"]),
    "commands of two": (data("runs/run10", "commands", np.zeros((5, 2))), ["/runs/run10/commands", "3 columns"]),
    "commands NaN": (entry("runs/run10/commands", (2, 2), np.nan), ["commands: y_rad[2]", "nan"]),
    "commands repeat": (entry("runs/run10/commands", (2, 0), 0.01), ["commands: t_s[2]", "increasing"]),
    "mirror all NaN": (entry(f"{MIRROR}/value", slice(None), np.nan), ["/runs/run10/mirror_x_rad/value", "NaN"]),
}


@pytest.mark.parametrize("kind", REFUSALS)
def test_refused_in_one_line_that_names_the_place(kind, path, monkeypatch):
    monkeypatch.setattr(reader, "probe_in_sandbox", lambda path: None)  # these files do no harm to the library
    damage, words = REFUSALS[kind]
    with h5py.File(path, "r+") as file:
        damage(file)
    message = refusal(path)
    for word in words:
        assert word in message


def test_what_is_no_hdf5_file_is_refused(tmp_path):
    path = tmp_path / "r.h5"
    assert "no file of this name" in refusal(path)
    path.write_bytes(b"no HDF5")
    assert "readable HDF5" in refusal(path)
    path.write_bytes(b"")
    assert "readable HDF5" in refusal(path)
    path.unlink()
    os.mkfifo(path)  # opening it would block until a writer appears
    assert "neither file nor folder" in refusal(path)


@pytest.mark.parametrize(
    "share", [0.02, *(pytest.param(share, marks=pytest.mark.slow) for share in (0.1, 0.5, 0.9)), 0.999]
)
def test_truncated_files_are_refused(path, share):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert "expected" in refusal(path)


def test_a_process_that_hangs_or_crashes_is_refused(path, monkeypatch):
    monkeypatch.setattr(hdf5, "CPU_LIMIT_S", 1)
    for program in ("_limit_resources(1)\nwhile True: pass", "import os; os.abort()"):
        monkeypatch.setattr(
            hdf5,
            "_PROGRAM",
            f"from optodrive.lab.recording.hdf5 import _limit_resources\n{program}",
        )
        assert "hangs or crashes" in refusal(path)


def test_a_process_that_could_not_start_is_not_called_damage(path, monkeypatch):
    monkeypatch.setattr(hdf5, "_PROGRAM", "raise ImportError('no such module')")
    assert "could not be tried out (ImportError: no such module)" in refusal(path)
    assert "damage" not in refusal(path)


def test_a_file_is_tried_out_once(path, monkeypatch):
    read_recording(path)
    monkeypatch.setattr(hdf5, "_PROGRAM", "import os; os.abort()")
    read_recording(path)


def test_damage_on_which_hdf5_2_0_searches_for_ever_comes_to_an_end(path, monkeypatch):
    monkeypatch.setattr(hdf5, "CPU_LIMIT_S", 1)
    content = bytearray(path.read_bytes())
    content[content.index(b"GCOL") + 24] = 255  # the length of the first text of the file
    path.write_bytes(content)
    with contextlib.suppress(InputError):  # a later library may read it
        read_recording(path)


def test_nothing_is_left_where_writing_fails(tmp_path):
    with pytest.raises(InputError, match="can be written"):
        write_recording(tmp_path / "nowhere" / "r.h5", recording())
    (tmp_path / "folder.h5").mkdir()
    with pytest.raises(InputError, match="can be written"):
        write_recording(tmp_path / "folder.h5", recording())
    assert [path.name for path in tmp_path.iterdir()] == ["folder.h5"]


ONE = recording().runs[0]
SIGNAL = ONE.signals["displacement_m"]
UNFIT = {
    "no runs": ((), "at least one run"),
    "a name twice": ((ONE, ONE), "unique names"),
    "a name of two parts": ((Run("a/b", 293.0, ONE.pulses, ONE.signals),), "'a/b'"),
    "the folder above": ((Run("..", 293.0, ONE.pulses, ONE.signals),), "'..'"),
    "an unknown signal": ((Run("a", 293.0, ONE.pulses, {"displacement_mm": SIGNAL}),), "nearest is 'displacement_m'"),
    "an attribute of a list": ((Run("a", 293.0, ONE.pulses, ONE.signals, {"x": [1, 2]}),), "/runs/a: x"),
    "text with NUL": ((Run("a", 293.0, ONE.pulses, ONE.signals, {"x": "a\0"}),), "/runs/a: x"),
    "text of surrogates": ((Run("a", 293.0, ONE.pulses, ONE.signals, {"x": "\ud800"}),), "/runs/a: x"),
    "a number too large": ((Run("a", 293.0, ONE.pulses, ONE.signals, {"x": 2**70}),), "/runs/a: x"),
    "an attribute like a signal": ((Run("a", 293.0, ONE.pulses, ONE.signals, {"force_N": 1.0}),), "'force_N'"),
    "ambient twice": ((Run("a", 293.0, ONE.pulses, ONE.signals, {"ambient_K": 1.0}),), "'ambient_K'"),
    "pulses of three": ((Run("a", 293.0, np.zeros((1, 3)), ONE.signals),), "/runs/a/pulses"),
    "commands of two": ((Run("a", 293.0, ONE.pulses, ONE.signals, {}, np.zeros((1, 2))),), "/runs/a/commands"),
    "fewer values": (
        (Run("a", 293.0, ONE.pulses, {"force_N": Signal(1, T_S, T_S[1:])}),),
        "/runs/a/force_N/value",
    ),
}


@pytest.mark.parametrize("name", ["r.h5", "folder"])
@pytest.mark.parametrize("kind", UNFIT)
def test_what_not_both_forms_can_carry_is_not_written(tmp_path, kind, name):
    runs, naming = UNFIT[kind]
    with pytest.raises(InputError, match="expected") as caught:
        write_recording(tmp_path / name, Measurement(runs))
    assert naming in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_numbers_of_numpy_are_written_as_numbers(tmp_path):
    signals = {"force_N": Signal(np.int64(3), T_S, T_S, np.float64(0.1))}
    run = Run("a", np.float64(293.15), ONE.pulses, signals, {"x": np.float64(0.5), "n": np.int32(3)})
    for name in ("r.h5", "folder"):
        write_recording(tmp_path / name, Measurement((run,)))
        (read,) = read_recording(tmp_path / name).runs
        assert read.attributes == {"x": 0.5, "n": 3}
        assert (read.ambient_k, read.signals["force_N"].sigma) == (293.15, 0.1)


def count_opens(monkeypatch, path):
    """Read a file as the sandboxed process does. Return how many times it opens the file."""
    opened = []

    class CountingTree(Hdf5Tree):
        def __init__(self, path):
            opened.append(path)
            super().__init__(path)

    monkeypatch.setattr(hdf5, "Hdf5Tree", CountingTree)
    monkeypatch.setattr(hdf5, "_extend_cpu_limit", lambda limit_s: None)
    hdf5._read_all(path, 5)
    return len(opened)


@pytest.mark.parametrize(("group", "read"), [("runs", read_recording), ("plans", read_trials)])
@pytest.mark.parametrize("is_soft", [True, False])
def test_links_cost_no_work_each_and_are_refused_by_name(path, monkeypatch, group, read, is_soft):
    """A link takes some bytes. Reading 60,000 of them took minutes, one opened file each."""
    with h5py.File(path, "r+") as file:
        first = next(iter(file["runs"].values()))
        links = file.require_group(group)
        for number in range(300):
            links[f"link{number}"] = h5py.SoftLink(first.name) if is_soft else first
    opens = count_opens(monkeypatch, path)
    assert opens <= 1 + len(recording().runs)
    monkeypatch.setattr(reader, "probe_in_sandbox", lambda path: None)
    found = "link" if is_soft else "second name of a group"
    with pytest.raises(InputError, match=rf": /{group}/\w+: got a {found}, expected"):
        read(path)


def test_more_attributes_than_a_recording_may_have_are_refused(path, monkeypatch):
    with h5py.File(path, "r+") as file:
        for number in range(1000):
            file.attrs[f"a{number}"] = number
    monkeypatch.setattr(reader, "probe_in_sandbox", lambda path: None)
    with pytest.raises(InputError, match="got 1003 attributes, expected at most 1000"):
        read_recording(path)
