"""Scripts of fingertips."""

import pytest

from optodrive.client.fingers import LIFTED_S, read_finger_script
from optodrive.core.errors import InputError
from optodrive.core.types.fingers import FingerPlace

HEADER = "time_s,number,x_m,y_m,radius_m\n"


def read(tmp_path, text):
    path = tmp_path / "hand.csv"
    path.write_text(text)
    return read_finger_script(path)


def test_rows_of_one_time_are_one_report_and_the_end_lifts_all(tmp_path):
    reports = read(tmp_path, HEADER + "0,1,0.01,0.02,0.004\n0,2,0.03,0.02,0.005\n0.5,1,0.011,0.02,0.004\n")
    assert reports == [
        (0.0, (FingerPlace(1, 0.01, 0.02, 0.004), FingerPlace(2, 0.03, 0.02, 0.005))),
        (0.5, (FingerPlace(1, 0.011, 0.02, 0.004),)),
        (0.5 + LIFTED_S, ()),
    ]


@pytest.mark.parametrize(
    ("text", "place"),
    [
        (HEADER, "hand.csv: got 'no row'"),
        (HEADER + "1,1,0,0,0.004\n0.5,1,0,0,0.004\n", "row 3: time_s: got 0.5"),
        (HEADER + "-1,1,0,0,0.004\n", "row 2: time_s: got -1"),
        (HEADER + "0,1,2.5,0,0.004\n", "row 2: x_m: got 2.5"),
        (HEADER + "0,1,0,0,0\n", "row 2: radius_m: got 0"),
        (HEADER + "0,1.5,0,0,0.004\n", "row 2: number: got 1.5"),
        (HEADER + "0,-1,0,0,0.004\n", "row 2: number: got -1"),
        (HEADER + "0,1,a,0,0.004\n", "row 2: x_m: got 'a'"),
        ("time,number\n", "first line"),
        (HEADER + "0,1,0,0,0.004\n" * 21, "got 21, expected at most 20"),
    ],
)
def test_a_wrong_script_is_refused_by_row_and_column(tmp_path, text, place):
    with pytest.raises(InputError) as refused:
        read(tmp_path, text)
    assert place in str(refused.value)
