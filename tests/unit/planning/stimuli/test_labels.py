"""Labels of a request: their bounds, and where they are read."""

import pytest

from displays import DISPLAYS
from optodrive.cli.play import add_labels, parse_label_options
from optodrive.core.errors import InputError
from optodrive.planning.stimuli.json_values import parse_labels
from optodrive.planning.stimuli.sequence_file import parse_sequence

CONFIG = DISPLAYS["display-16"].config
FRAMES = [{"show_at_s": 0, "duration_s": 1, "target_um": {"1": 50}}]
LABELS = {"subject": "S07 µ", "trial": 12, "gain": 0.5, "practice": False, "note": ""}


def test_labels_keep_their_values():
    assert parse_labels(LABELS, "labels") == LABELS
    assert len(parse_sequence({"frames": FRAMES, "labels": LABELS}, CONFIG, "body").frames) == 1


@pytest.mark.parametrize(
    ("labels", "code"),
    [
        ([], "bad_label"),
        ({"": 1}, "bad_label"),
        ({"k" * 65: 1}, "bad_label"),
        ({"a\n": 1}, "bad_label"),
        ({"a": "x" * 257}, "bad_label"),
        ({"a": "x\x00"}, "bad_label"),
        ({"a": None}, "bad_label"),
        ({"a": [1]}, "bad_label"),
        ({"a": float("nan")}, "bad_label"),
        ({"a": 2**54}, "bad_label"),
        ({"a": 10**400}, "bad_label"),
        ({str(k): k for k in range(33)}, "too_many"),
    ],
)
def test_labels_beyond_their_bounds_are_refused(labels, code):
    with pytest.raises(InputError) as caught:
        parse_sequence({"frames": FRAMES, "labels": labels}, CONFIG, "body")
    assert caught.value.code == code
    assert len(str(caught.value)) < 400


def test_labels_alone_are_no_request():
    with pytest.raises(InputError, match="neither frames nor trains"):
        parse_sequence({"labels": LABELS}, CONFIG, "body")


def test_options_of_the_command_line():
    assert parse_label_options(["a=1", "b=0.5", "c=true", "d=x=y", "e=null", "f="]) == {
        "a": 1, "b": 0.5, "c": True, "d": "x=y", "e": "null", "f": ""
    }  # fmt: skip
    assert add_labels("f.json", b'{"frames": [], "labels": {"a": 1, "b": 2}}', ["b=3"]) == {
        "frames": [],
        "labels": {"a": 1, "b": 3},
    }
    with pytest.raises(InputError, match="--label: got 'a', expected KEY=VALUE"):
        parse_label_options(["a"])
