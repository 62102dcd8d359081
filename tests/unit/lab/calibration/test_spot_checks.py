"""Checks of valid and invalid spots."""

import csv

import numpy as np
import pytest
from openpyxl import Workbook, load_workbook

from hidden_field import CONFIG, PRIOR, grid_codes, measure_spots, random_codes
from optodrive.core.errors import InputError
from optodrive.lab.calibration.field_fit import fit_field
from optodrive.lab.calibration.spot_checks import check_fit, check_spots
from optodrive.lab.calibration.spots import MeasuredSpots, read_spots, write_spots
from optodrive.link.simulator.true_geometry import GroundTruthGeometry

RANDOM = np.random.default_rng(4)
MANY, NINE, SIX = (
    measure_spots(GroundTruthGeometry.sample(seed, CONFIG), codes, RANDOM, share)[0].to_table()
    for seed, codes, share in ((0, grid_codes(17), 0.2), (1, grid_codes(3), 0.0), (2, random_codes(RANDOM, 6), 0.0))
)


def collapse_to_one_place(table, noise_m):
    return np.column_stack(
        [table[:, :2], [1e-3, 2e-3] + noise_m * np.random.default_rng(1).standard_normal((len(table), 2))]
    )


WRONG_TABLES = {
    "x mirrored": lambda t: t * [1, 1, -1, 1],
    "y mirrored": lambda t: t * [1, 1, 1, -1],
    "half a turn": lambda t: t * [1, 1, -1, -1],
    "exchanged": lambda t: t[:, [0, 1, 3, 2]],
    "quarter turn": lambda t: t[:, [0, 1, 3, 2]] * [1, 1, -1, 1],
    "inches": lambda t: t / [1, 1, 0.0254, 0.0254],
    "millimetres": lambda t: t * [1, 1, 1e3, 1e3],
    "micrometres": lambda t: t * [1, 1, 1e6, 1e6],
    "distances (2|1.99)": lambda t: t * [1, 1, 2, 2],
    "all spots were measured at one place": lambda t: collapse_to_one_place(t, 1e-5),
    "this mirror does not move": lambda t: np.column_stack([t[:, :2], np.full(len(t), 1e-3), t[:, 3]]),
    "on a line": lambda t: t[:, [0, 0, 2, 2]],
    "several places": lambda t: np.column_stack([np.full((len(t), 2), 3e4), t[:, 2:]]),
    "at least 6": lambda t: t[:5],
    "nearly all look like outliers": lambda t: np.column_stack(
        [t[:, :2], np.random.default_rng(2).uniform(-0.036, 0.036, (len(t), 2))]
    ),
    "turned by": lambda t: np.column_stack([t[:, :2], t[:, 2:] @ [[0.9, 0.44], [-0.44, 0.9]]]),
    "middle": lambda t: t + np.array([0, 0, 0.02, 0]),
}


@pytest.mark.parametrize("table", [MANY, NINE, SIX], ids=["289", "9", "6"])
def test_valid_spots_pass(table):
    check_spots("spots.csv", MeasuredSpots.from_table(table), PRIOR)
    check_fit("spots.csv", fit_field(MeasuredSpots.from_table(table), PRIOR))


@pytest.mark.parametrize("named", WRONG_TABLES)
@pytest.mark.parametrize("table", [MANY, NINE, SIX], ids=["289", "9", "6"])
def test_the_cause_of_invalid_spots_is_named(named, table):
    with pytest.raises(InputError, match=named) as caught:
        check_spots("spots.csv", MeasuredSpots.from_table(WRONG_TABLES[named](table)), PRIOR)
    assert "\n" not in str(caught.value)
    assert "…" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("x,y,x_m,y_m\n1,2,3,4\n", "first line"),
        ("x_code,y_code,x_m,y_m\n1,2,3\n", "row 2"),
        ("x_code,y_code,x_m,y_m\n1,2,0.1,0.2\n1,2,here,0\n", "row 3: x_m: got 'here'"),
        ("x_code,y_code,x_m,y_m\n1,2,nan,0\n", "row 2: x_m"),
        ("x_code,y_code,x_m,y_m\n1,70000,0,0\n", "row 2: y_code"),
        ("# optodrive spots of mine\nx_code,y_code,x_m,y_m\n1,70000,0,0\n", "row 3: y_code"),
        ("# a note\n# another\nx_code,y_code,x_m,y_m\n1,x,0,0\n", "row 4: y_code"),
        ("# a note\nx_code,y_code,x_m\n1,2,0\n", "line 2"),
        ("x_code,y_code,x_m,y_m\n0.01,0.02,32768,32768\n", "exchanged"),
        ("x_code,y_code,x_m,y_m\n0.01,0.02,0.01,0.02\n", "look like metres"),
    ],
)
def test_a_file_without_spots_is_refused(tmp_path, text, named):
    path = tmp_path / "spots.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=named):
        read_spots(path)


def test_spots_round_trip(tmp_path):
    write_spots(tmp_path / "spots.csv", MeasuredSpots.from_table(MANY), "mine")
    assert np.allclose(read_spots(tmp_path / "spots.csv").to_table(), MANY, atol=1e-10)


def test_spots_of_another_display_are_refused_by_name(tmp_path):
    path = tmp_path / "spots.csv"
    write_spots(path, MeasuredSpots.from_table(MANY), "mine")
    assert len(read_spots(path, "mine")) == len(read_spots(path)) == len(MANY)
    with pytest.raises(InputError, match="spots: got 'those of mine', expected those of yours"):
        read_spots(path, "yours")
    path.write_text(path.read_text().partition("\n")[2])  # a table of a user's own
    assert len(read_spots(path, "yours")) == len(MANY)


def shift_positions(table, rows):
    """Return spots whose positions stand some rows late, the first ones in the place of the last."""
    return np.column_stack([table[:, :2], np.roll(table[:, 2:], rows, axis=0)])


def check_both(spots):
    check_spots("s.csv", spots, PRIOR)
    check_fit("s.csv", fit_field(spots, PRIOR))


def shuffled(table):
    return np.random.default_rng(3).permutation(table)


@pytest.mark.parametrize("order", ["rows", "columns", "any"])
@pytest.mark.parametrize("lag", [1, -1])
@pytest.mark.parametrize("side", [5, 9, 17])
def test_positions_one_row_late_or_early_are_named(side, lag, order):
    geometry = GroundTruthGeometry.sample(side, CONFIG)
    table = measure_spots(geometry, grid_codes(side), np.random.default_rng(side), 0.0)[0].to_table()
    if order != "rows":
        table = shuffled(table) if order == "any" else table[np.lexsort((table[:, 1], table[:, 0]))]
    good, wrong = (MeasuredSpots.from_table(each) for each in (table, shift_positions(table, lag)))
    check_both(good)
    named = f"positions that belong to the codes one row {'above' if lag > 0 else 'below'}"
    with pytest.raises(InputError, match=named):
        check_both(wrong)


@pytest.mark.parametrize("count", [2, 3, 8])
def test_copies_of_rows_are_refused_by_name(tmp_path, count):
    path = tmp_path / "spots.csv"
    write_spots(path, MeasuredSpots.from_table(np.tile(NINE, (count, 1))), "mine")
    said = f"row 12: got the numbers of row 3, as {9 * (count - 1)} rows in all repeat others"
    with pytest.raises(InputError, match=said):
        read_spots(path)


def format_rows(names, rows, separator, decimal=".", quote=""):
    """Return a table as a spreadsheet writes it."""
    cells = [[f"{quote}{name}{quote}" for name in names]]
    cells += [[f"{value:.12g}".replace(".", decimal) for value in row] for row in rows]
    if separator == "," and decimal == ",":
        cells = [cells[0], *([f'"{cell}"' for cell in row] for row in cells[1:])]
    return "".join(separator.join(row) + "\r\n" for row in cells)


NAMES = ("x_code", "y_code", "x_m", "y_m")
MILLIMETRES = ("x_code", "y_code", "x_mm", "y_mm")
DIALECTS = {
    "LibreOffice": (format_rows(NAMES, NINE, ",", quote='"'), "utf-8"),
    "LibreOffice, German": (format_rows(NAMES, NINE, ";", ",", '"'), "utf-8"),
    "quoted decimal commas": (format_rows(NAMES, NINE, ",", ","), "utf-8"),
    "Excel, UTF-8": (format_rows(NAMES, NINE, ";", ","), "utf-8-sig"),
    "Excel, Unicode text": (format_rows(NAMES, NINE, "\t", ","), "utf-16"),
    "UTF-16 without a mark": (format_rows(NAMES, NINE, "\t"), "utf-16-be"),
    "Excel's line of the separator": ("sep=;\r\n" + format_rows(NAMES, NINE, ";", ","), "utf-8"),
    "a note and empty rows": (
        "# optodrive spots of mine;;;\n" + format_rows(NAMES, NINE, ";", ",") + ";;;\r\n;;;\r\n",
        "utf-8",
    ),
    "old Macintosh": (format_rows(NAMES, NINE, ",").replace("\r\n", "\r"), "utf-8"),
    "other columns, another order": (
        format_rows(("time", "y_m", "x_m", "x_code", "y_code"), NINE[:, [0, 3, 2, 0, 1]], ","),
        "utf-8",
    ),
    "millimetres": (format_rows(MILLIMETRES, NINE * [1, 1, 1e3, 1e3], ","), "utf-8"),
    "units in brackets": (
        format_rows(("X_code", "Y_code", "x [mm]", "y (µm)"), NINE * [1, 1, 1e3, 1e6], "\t"),
        "utf-8",
    ),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_what_spreadsheets_write_is_read(tmp_path, dialect):
    text, encoding = DIALECTS[dialect]
    (tmp_path / "spots.csv").write_bytes(text.encode(encoding))
    assert np.allclose(read_spots(tmp_path / "spots.csv", "mine").to_table(), NINE, rtol=1e-9, atol=1e-12)


def test_what_openpyxl_reads_of_a_sheet_is_the_same(tmp_path):
    """A sheet that was typed in, saved, read again and exported."""
    book = Workbook()
    for row in (NAMES, *NINE.tolist()):
        book.active.append(row)
    book.save(tmp_path / "spots.xlsx")
    with (tmp_path / "spots.csv").open("w", newline="") as file:
        csv.writer(file, dialect="excel").writerows(load_workbook(tmp_path / "spots.xlsx").active.values)
    assert np.allclose(read_spots(tmp_path / "spots.csv").to_table(), NINE)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"x_code,y_code,x_m\n1,2,3\n", "got columns 'x_code', 'y_code', 'x_m', expected a column y_m too"),
        (b"x_code,y_code,x_m,y_metre\n1,2,3,4\n", "expected a column y_m too .nearest is 'y_m"),
        (b"x_code,y_code,x_m,x_mm,y_m\n1,2,3,4,5\n", "got 'x_m' and 'x_mm', expected one column x_m"),
        (b"1,2,3,4\n5,6,7,8\n", "got numbers, expected the names of the columns"),
        (b"\n1,2,3,4\n", "got an empty line, expected a column x_code"),
        (b"x_code,y_code,x_m,y_m\n1,5,2,5,3,5,4,5\n", "decimal commas need semicolons"),
        (b"x_code;y_code;x_m;y_m\n1;2;1.000,5;4\n", "row 2: x_m: got '1.000,5', expected a number"),
        (b"x_code,y_code,x_m,y_m\n\xff\xfe1,2,3,4\n", "a CSV file in UTF-8 or UTF-16"),
        (b"", "got an empty line"),
    ],
)
def test_another_table_is_refused_by_what_was_found(tmp_path, content, said):
    (tmp_path / "spots.csv").write_bytes(content)
    with pytest.raises(InputError, match=said) as refused:
        read_spots(tmp_path / "spots.csv")
    assert "\n" not in str(refused.value)
