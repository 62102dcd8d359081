"""Messages of fingertips that the display cannot have: one line with place, value and expectation."""

import pytest

from optodrive.core.errors import InputError
from optodrive.daemon.responses.messages import FINGERS_MAX, validate_fingers

FINGER = {"number": 1, "x_m": 0.0, "y_m": 0.0, "radius_m": 0.004}


@pytest.mark.parametrize(
    ("message", "line"),
    [
        ({"fingers": [FINGER, FINGER | {"x_m": 2.0}]}, "fingers.1.x_m: got 2.0, expected less than or equal to 1"),
        ({"fingers": [FINGER | {"number": 1.5}]}, "fingers.0.number: got 1.5, expected a whole number"),
        ({"fingers": [FINGER | {"radius_m": 0.0}]}, "fingers.0.radius_m: got 0.0, expected greater than 0"),
        (
            {"fingers": [FINGER | {"speed": 1.0}]},
            "fingers.0.speed: got 'speed', expected a known key, one of number, x_m, y_m, radius_m",
        ),
        ({"fingers": [{"number": 1}]}, "fingers.0.x_m: missing, expected this key"),
        ({"fingers": [FINGER] * (FINGERS_MAX + 1)}, "fingers: got 21 of them, expected at most 20"),
        ({"fingers": [], "age_s": 3.0}, "age_s: got 3.0, expected less than or equal to 1"),
    ],
)
def test_a_wrong_member_is_named_with_its_value_and_the_expected_one(message, line):
    with pytest.raises(InputError) as refused:
        validate_fingers(message)
    assert str(refused.value) == f"message: {line}"
