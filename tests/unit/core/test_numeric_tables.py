"""CSV tables: cells that a spreadsheet would run, and every reader of a table in every dialect."""

import numpy as np
import pytest

from optodrive.client.fingers import read_finger_script
from optodrive.core.errors import InputError
from optodrive.core.numeric_tables import escape_formula, open_table, read_columns
from optodrive.lab.calibration.pictures import SpotsSection, _list_by_table
from optodrive.lab.discovery.model import OdeModel, Parameter, read_record
from optodrive.lab.recording.csv_folder import CsvTree


@pytest.mark.parametrize(
    "cell", ["=1+1", '=HYPERLINK("http://a")', "+A1", "-A1", "@SUM(1)", "\t=1", "\r=1", "--1", "=="]
)
def test_a_formula_gets_an_apostrophe(cell):
    assert escape_formula(cell) == f"'{cell}"


@pytest.mark.parametrize("cell", ["", "a=1", "-", "+", "-1.5", "+1e-3", " =1", -1.5, None, True])
def test_other_text_and_numbers_stay(cell):
    assert escape_formula(cell) is cell


def _write(path, names, rows, separator=",", decimal=".", quote="", end="\n", encoding="utf-8", above=""):
    """Write a table in a dialect; a cell is text or a number."""
    cells = [
        names,
        *([str(cell).replace(".", decimal) if isinstance(cell, float) else cell for cell in r] for r in rows),
    ]
    quotes = [quote if quote or separator != decimal or k == 0 else '"' for k in range(len(cells))]
    lines = [separator.join(f"{q}{cell}{q}" for cell in row) for q, row in zip(quotes, cells, strict=True)]
    path.write_bytes((above + end.join(lines) + end).encode(encoding))


DIALECTS = {
    "plain": {},
    "quotes": {"quote": '"', "end": "\r\n"},
    "German": {"separator": ";", "decimal": ",", "encoding": "utf-8-sig"},
    "quoted decimal commas": {"decimal": ","},
    "Unicode text": {"separator": "\t", "decimal": ",", "encoding": "utf-16", "end": "\r\n"},
    "UTF-16 without a mark": {"separator": "\t", "encoding": "utf-16-be"},
    "separator's line": {"separator": ";", "decimal": ",", "above": "sep=;\r\n", "end": "\r\n"},
    "notes": {"above": "# by hand\n# at night\n"},
    "old Macintosh": {"end": "\r"},
}


def _read_spots(folder, write):
    write(folder / "t.csv", ("x_code", "y_m"), [[k, 0.25 * k] for k in range(1, 4)])
    return read_columns(folder / "t.csv", ("x_code", "y_m"))


def _read_pictures(folder, write):
    write(folder / "p.csv", ("file", "x_code", "y_code"), [[f"a.{k}.png", k + 0.5, 2.5] for k in range(3)])
    for k in range(3):
        (folder / f"a.{k}.png").touch()
    found = _list_by_table(folder, SpotsSection(table="p.csv").table)
    return [[int(each.path.name[2]), each.x_code, each.y_code] for each in found]


MODEL = OdeModel(("s",), ("u",), ("y",), {"p": Parameter(1.0, 0.1, 2.0)}, None, None, None)


def _read_record(folder, write):
    write(folder / "r.csv", ("t_s", "u", "y"), [[0.5 * k, 1.5, "" if k == 3 else 0.25] for k in range(6)])
    record = read_record(folder / "r.csv", MODEL)
    return np.column_stack([record.t_s, record.inputs, record.outputs])


def _read_recording(folder, write):
    (folder / "recording.toml").write_text("[runs.one]\nambient_K = 293\n")
    (folder / "one").mkdir()
    write(folder / "one" / "pulses.csv", ("start_s", "width_s", "power_W", "pixel"), [[0.5, 0.25, 1.5, 3]])
    write(folder / "one" / "displacement_m.csv", ("t_s", "value"), [[0.5, 1.5e-5], [1.5, ""], [2.5, 0.25]])
    tree = CsvTree(folder)
    t_s, value = tree.read_samples("one", "displacement_m")
    assert tree.count_samples("one", "displacement_m") == 3
    return [*tree.read_table("one", "pulses").ravel(), *t_s, *value]


def _read_fingers(folder, write):
    columns = ("time_s", "number", "x_m", "y_m", "radius_m")
    write(folder / "f.csv", columns, [[0.5, 1, 0.001, 0.002, 0.005]])
    return read_finger_script(folder / "f.csv")[0]


READERS = [_read_spots, _read_pictures, _read_record, _read_recording, _read_fingers]


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_reader_reads_every_dialect(tmp_path, reader, dialect):
    (tmp_path / "plain").mkdir()
    (tmp_path / "other").mkdir()
    plain = reader(tmp_path / "plain", _write)

    def write_dialect(path, names, rows):
        """Write the columns in another order, with a further one."""
        table = [[*row[::-1], more] for row, more in zip([names, *rows], ["remark", *"x" * len(rows)], strict=True)]
        _write(path, table[0], table[1:], **DIALECTS[dialect])

    other = reader(tmp_path / "other", write_dialect)
    if reader is _read_fingers:
        assert other == plain
    else:
        np.testing.assert_array_equal(other, plain)


@pytest.mark.parametrize(
    ("header", "row", "numbers"),
    [
        ("t [ms],power (mW),phi_deg", "5,1500,180", [0.005, 1.5, np.pi]),
        ("T_S,POWER_W,PHI_RAD", "5,1.5,2", [5.0, 1.5, 2.0]),
        ("t_us,power_W,phi [mrad]", "5,1.5,2", [5e-6, 1.5, 2e-3]),
    ],
)
def test_units_of_names_are_converted(tmp_path, header, row, numbers):
    (tmp_path / "t.csv").write_text(f"{header}\n{row}\n")
    with open_table(tmp_path / "t.csv", ("t_s", "power_W", "phi_rad")) as table:
        assert table.read_numbers() == pytest.approx(np.array([numbers]), rel=1e-12)


def test_names_that_differ_in_case_alone_are_told_apart(tmp_path):
    (tmp_path / "t.csv").write_text("T_s,t_s\n1,2\n")
    assert read_columns(tmp_path / "t.csv", ("t_s", "T_s")).tolist() == [[2.0, 1.0]]


AMBIGUOUS = {
    "two units": ("t_s,t_ms,y\n1,2,3\n", "first line: got 't_s' and 't_ms', expected one column t_s"),
    "twice": ("t_s;y;y\n1;2;3\n", "first line: got 'y' and 'y', expected one column y"),
    "two cases": ("t_s,Y,Y\n1,2,3\n", "got 'Y' and 'Y', expected one column y"),
    "both signs": ("t_s;y\n1,5;2.5\n", "row 2: got '1,5;2.5', expected decimal points or decimal commas, not both"),
    "thousands": ("t_s;y\n1;1.000,5\n", "row 2: y: got '1.000,5', expected a number"),
    "decimal commas": ("t_s,y\n1,5,2,5\n", "row 2: got 4 cells, '1,5,2,5', expected 2 cells, as in the header: dec"),
    "a longer row": ("t_s;y\n1;2\n1;2;3\n", "row 3: got 3 cells, '1;2;3', expected 2 cells, as in the header"),
    "a shorter row": ("t_s;y\n1\n", "row 2: got 1 cells, '1', expected 2 cells"),
    "a remark": ("t_s;y\n1;2\n\n;;\n1;two\n", "row 5: y: got 'two', expected a number"),
    "no end": ('t_s;y\n1;"2' + 200_000 * "1", "expected a CSV file"),
}


@pytest.mark.parametrize("case", AMBIGUOUS)
def test_what_can_be_read_in_two_ways_is_refused_by_name(tmp_path, case):
    content, said = AMBIGUOUS[case]
    (tmp_path / "t.csv").write_text(content)
    with pytest.raises(InputError) as refused, open_table(tmp_path / "t.csv", ("t_s", "y")) as table:
        table.read_numbers()
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)
