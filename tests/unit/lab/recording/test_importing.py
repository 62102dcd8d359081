"""Files of instruments, written here as oscilloscopes and loggers write them, become recordings by a map."""

import csv
import io
from contextlib import suppress

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat

from optodrive.cli.main import run
from optodrive.core.errors import InputError
from optodrive.lab.recording import read_recording, write_recording
from optodrive.lab.recording.import_map import propose_map
from optodrive.lab.recording.importing import import_recording
from optodrive.lab.recording.instrument_files import read_instrument_file

T_S = np.arange(0.0, 0.2, 1e-3)
RISE_M = 2e-5 * (1.0 - np.exp(-np.clip(T_S - 0.01, 0.0, None) / 0.02))
GATE_V = np.where((T_S >= 0.01) & (T_S < 0.03), 5.0, 0.0)
MAP = """
format = "optodrive-import"
version = 1
[time]
{time}
trigger_s = 0.01
[signals.displacement_m]
column = "{column}"
sign = {sign}
pixel = 17
{unit}
{gate}
[runs.first]
file = "{file}"
ambient_k = 295.0
{run}
"""
GATE = '[gate]\ncolumn = "gate"\nthreshold = 2.5\npower_w = 2.45\npixel = 17'


def write_map(folder, file, **values):
    stated = {"time": 'column = "time"', "column": "height", "sign": 1, "unit": "", "gate": "", "run": ""} | values
    path = folder / "map.toml"
    path.write_text(MAP.format(file=file, **stated), encoding="utf-8")
    return path


def write_scope(path, separator=";", decimal=",", encoding="utf-16", units="row", before=3):
    names, stated = ["time", "height", "gate"], ["ms", "µm", "V"]
    text = io.StringIO()
    writer = csv.writer(text, delimiter=separator, lineterminator="\r\n")
    for at in range(before):
        writer.writerow([f"Setting {at}", "on"])
    writer.writerow(
        [f"{name} ({unit})" for name, unit in zip(names, stated, strict=True)] if units == "name" else names
    )
    if units == "row":
        writer.writerow([f"({unit})" for unit in stated])
    for row in np.column_stack([1e3 * T_S, 1e6 * RISE_M, GATE_V]):
        writer.writerow([f"{value:.6f}".replace(".", decimal) for value in row])
    path.write_bytes(text.getvalue().encode(encoding))


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from([(";", ","), ("\t", ","), (";", "."), ("\t", "."), (",", ".")]),
    st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    st.sampled_from(["row", "name"]),
    st.integers(0, 5),
)
def test_every_dialect_gives_the_same_samples(tmp_path_factory, marks, encoding, units, before):
    folder = tmp_path_factory.mktemp("import")
    write_scope(folder / "scope.csv", *marks, encoding, units, before)
    measurement, _ = import_recording(write_map(folder, "scope.csv", gate=GATE))
    signal = measurement.runs[0].signals["displacement_m"]
    assert signal.pixel == 17
    np.testing.assert_allclose(signal.t_s, T_S - 0.01, atol=1e-9)
    np.testing.assert_allclose(signal.value, RISE_M, atol=1e-12)
    # The edges lie half a sample before the first sample beyond the threshold.
    np.testing.assert_allclose(measurement.runs[0].pulses, [[-0.0005, 0.02, 2.45, 17.0]], atol=1e-9)
    write_recording(folder / "out", measurement)
    np.testing.assert_array_equal(read_recording(folder / "out").runs[0].signals["displacement_m"].value, signal.value)


def test_scale_sign_and_pulses_of_a_file_are_as_stated(tmp_path):
    rows = "\n".join(f"{t:.3f},{3.0 - 1e5 * height:.6f}" for t, height in zip(T_S, RISE_M, strict=True))
    (tmp_path / "logger.txt").write_text(f"time,sensor\n{rows}\n")
    (tmp_path / "pulses.csv").write_text("start_s,width_s,power_W,pixel\n0,0.02,2.45,17\n")
    path = write_map(
        tmp_path,
        "logger.txt",
        time='column = "time"\nunit = "s"',
        column="sensor",
        sign=-1,
        unit="scale = 1e-5\noffset = 3e-5",
        run='pulses = "pulses.csv"\ngroup = "weak"\ncoupling = "DC"',
    )
    run = import_recording(path)[0].runs[0]
    np.testing.assert_allclose(run.signals["displacement_m"].value, RISE_M, atol=1e-10)
    assert (run.pulses.tolist(), run.ambient_k) == ([[0.0, 0.02, 2.45, 17.0]], 295.0)
    assert run.attributes == {"group": "weak", "coupling": "DC"}


def write_tdms(path):
    waveform = {"wf_increment": 1e-3, "wf_start_offset": 0.0}
    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject("laser", "height", 1e6 * RISE_M, waveform | {"unit_string": "µm"})])


def write_lvm(path):
    head = ["LabVIEW Measurement", "Writer_Version\t2", "Separator\tTab", "Decimal_Separator\t,", "X_Columns\tOne"]
    head += ["***End_of_Header***", "", "Channels\t1", f"Samples\t{len(T_S)}", "Y_Unit_Label\tµm", "X0\t0,0"]
    head += ["Delta_X\t0,001", "***End_of_Header***", "X_Value\theight\tComment"]
    rows = [f"{t:.4f}\t{1e6 * height:.6f}".replace(".", ",") for t, height in zip(T_S, RISE_M, strict=True)]
    path.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")


def write_mat5(path):
    savemat(path, {"time": T_S, "height": 1e6 * RISE_M})


def write_mat73(path):
    with h5py.File(path, "w", userblock_size=512) as file:
        file["time"], file["height"] = T_S.reshape(1, -1), 1e6 * RISE_M.reshape(1, -1)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")


SECONDS = 'column = "time"\nunit = "s"'


@pytest.mark.parametrize(
    ("name", "write", "values"),
    [
        ("a.tdms", write_tdms, {"time": ""}),
        ("a.lvm", write_lvm, {"time": 'column = "X_Value"'}),
        ("a.mat", write_mat5, {"time": SECONDS, "unit": 'unit = "µm"'}),
        ("a.mat", write_mat73, {"time": SECONDS, "unit": 'unit = "um"'}),
    ],
)  # fmt: skip
def test_files_of_programs_are_read_by_their_libraries(tmp_path, name, write, values):
    write(tmp_path / name)
    signal = import_recording(write_map(tmp_path, name, **values))[0].runs[0].signals["displacement_m"]
    np.testing.assert_allclose(signal.t_s, T_S - 0.01, atol=1e-9)
    np.testing.assert_allclose(signal.value, RISE_M, atol=1e-12)


def test_gaps_clocks_and_notes_beside_the_numbers_are_read(tmp_path):
    lines = ["Date,Temp (°C)", "2026-11-28 23:59:59.5,20.0", "2026-11-29 00:00:00.0,", "2026-11-29 00:00:00.5,OL"]
    lines += [f"2026-11-29 00:00:0{at}.0,{20 + at}" for at in range(1, 9)]
    (tmp_path / "a.csv").write_text("\n".join(lines), encoding="utf-8")
    time, value = (column.value for column in read_instrument_file(tmp_path / "a.csv").columns)
    np.testing.assert_allclose(time, [0.0, 0.5, 1.0, *np.arange(1.5, 9.0)])
    assert np.isnan(value[1:3]).all()
    rows = ["Record Length,2500,Points,0.0,", "Interval,0.001,s,0.1,1.6", "Source,CH1,,0.2,1.7"]
    (tmp_path / "b.csv").write_text("\n".join([*rows, *(f",,,0.{at},1.{at}" for at in range(3, 9))]))
    file = read_instrument_file(tmp_path / "b.csv")
    assert [column.name for column in file.columns] == ["column 4", "column 5"]
    # A first sample that is missing leaves the column in place, and what is not read is named.
    np.testing.assert_equal(file.columns[1].value[:3], [np.nan, 1.6, 1.7])
    assert file.notes[2:] == tuple(f"'column {at}' not read: text" for at in (1, 2, 3))
    (tmp_path / "c.csv").write_text("clock,b\n23:59:59,1\n,2\n00:00:01,3\n")
    np.testing.assert_equal(read_instrument_file(tmp_path / "c.csv").columns[0].value, [0.0, np.nan, 2.0])


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"column": "heigth"}, ("signals.displacement_m: column", "'heigth' in none", "'height'")),
        ({"unit": 'unit = "mm"'}, ("unit: got 'mm'", "'µm', as", "states")),
        ({"unit": "scale = 2.0"}, ("scale: got 2.0", "the column is in µm")),
        ({"unit": "offset = 2.0"}, ("offset: got 2.0", "none without scale")),
        ({"column": "gate"}, ("column: got a column in V", "scale in m per unit")),
        ({"sign": 2}, ("signals.displacement_m.sign: got 2",)),
        ({"time": 'column = "height"'}, ("time.unit: got 'µm'", "the unit of the times")),
        ({"time": ""}, ("no times of 'height'", "column or rate_hz")),
        ({"time": 'column = "time"\nrate_hz = 5.0'}, ("rate_hz: got 5.0", "not both")),
        ({"gate": GATE.replace("2.5", "9.5")}, ("gate.threshold: got 9.5", "between 0 and 5")),
        ({"gate": GATE.replace('"gate"', '"time"').replace("2.5", "50")}, ("a pulse at the end of 'time'",)),
        ({"gate": GATE, "run": 'pulses = "p.csv"'}, ("[gate] beside pulses",)),
        ({"run": "ambient_c = 22.0"}, ("runs.first.ambient_c", "ambient_k")),
    ],
)
def test_what_stays_ambiguous_is_refused_in_one_line(tmp_path, values, words):
    write_scope(tmp_path / "scope.csv")
    with pytest.raises(InputError) as error:
        import_recording(write_map(tmp_path, "scope.csv", **values))
    message = str(error.value)
    assert all(word in message for word in words), message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a;b\n1,5;2.5\n3,5;4.5\n", ("'2.5' and '1,5'", "not both")),
        ("a,b\n1,2\n3,4\n5\n6,7\n", ("line 4", "1 cells", "2")),
        ("a,b\n1,2\n3,word\n5,6\n", ("b, row 2 of the numbers", "'word'")),
        ("a,b\n10:00:00,2\n5,3\n", ("a: got times beside numbers",)),
        ("only words\nand more\n", ("no rows of numbers",)),
        ("", ("no rows of numbers",)),
    ],
)
def test_a_text_that_can_be_read_in_two_ways_is_refused(tmp_path, text, words):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError) as error:
        read_instrument_file(tmp_path / "a.csv")
    assert all(word in str(error.value) for word in words), str(error.value)


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(["a.csv", "a.lvm", "a.tdms", "a.mat"]),
    st.binary(max_size=300) | st.text(',;\t 1.5\n"ab', max_size=200),
)
def test_random_content_is_read_or_refused(tmp_path_factory, name, content):
    path = tmp_path_factory.mktemp("random") / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with suppress(InputError):  # in one line, by its own check
        assert read_instrument_file(path).columns


def test_a_proposed_map_needs_only_what_the_file_does_not_state(tmp_path):
    write_scope(tmp_path / "scope.csv")
    text = propose_map([read_instrument_file(tmp_path / "scope.csv")])
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(InputError, match="trigger_s: missing"):
        import_recording(tmp_path / "map.toml")
    signal, _, rest = text.partition('column = "gate"')[0].rpartition("\n\n")[0], "", ""
    filled = signal.replace("# trigger_s = …", "trigger_s = 0.01").replace("# [signals.", "[signals.")
    filled = filled.replace('# column = "height"', 'column = "height"').replace("# sign", "sign")
    filled = filled.replace("# pixel = …", "pixel = 17")
    runs = text[text.index("[runs.") :].replace("# ambient_k = …", "ambient_k = 295.0")
    (tmp_path / "map.toml").write_text(f"{filled}\n\n{rest}{runs}")
    np.testing.assert_allclose(
        import_recording(tmp_path / "map.toml")[0].runs[0].signals["displacement_m"].value, RISE_M, atol=1e-12
    )


def test_the_command_prints_what_it_took_for_what_and_the_first_page(tmp_path, capsys):
    write_scope(tmp_path / "scope.csv")
    path = write_map(tmp_path, "scope.csv", gate=GATE)
    assert run(["recording", "import", "--map", str(path), "--out", str(tmp_path / "r.h5")]) == 0
    out = capsys.readouterr().out
    assert "utf-16, separator ';', decimal ','; numbers from line 6, 0 gaps" in out
    assert "height [µm]: 200 samples: 0, 0, 0, …" in out
    assert "Nothing is left out." in out
    assert "no pulses" not in out
    assert len(read_recording(tmp_path / "r.h5").runs[0].pulses) == 1
    assert run(["recording", "import", str(tmp_path / "scope.csv")]) == 0
    assert "# trigger_s = …" in capsys.readouterr().out
    for arguments in (
        [],
        [str(path), "--out", "x"],
        ["--map", str(path)],
        ["--map", str(path), str(path), "--out", "y"],
    ):
        assert run(["recording", "import", *arguments]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
