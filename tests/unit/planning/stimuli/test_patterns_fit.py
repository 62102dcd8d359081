"""Patterns with their defaults, and low pictures, fit: their frames last as long as beam and mirrors need."""

from base64 import b64encode
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from displays import DISPLAYS
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.stimuli.pattern_registry import PATTERNS, build_pattern


def picture():
    buffer = BytesIO()
    ramp = np.add.outer(np.arange(64), np.arange(64)) * 2
    Image.fromarray(ramp.astype(np.uint8)).save(buffer, "PNG")
    return b64encode(buffer.getvalue()).decode()


TAP = (
    b'{"Version": 1, "Pattern": [{"Event": {"Time": 0, "EventType": "HapticTransient", "EventParameters": '
    b'[{"ParameterID": "HapticIntensity", "ParameterValue": 1}]}}]}'
)
CLICK = b"RIFF,\0\0\0WAVEfmt \x10\0\0\0\1\0\1\0@\x1f\0\0@\x1f\0\0\1\0\x08\0data\x08\0\0\0\xff\0\xff\0\xff\0\xff\0"
NEEDED = {
    "text": {"text": "hello"},
    "image": {"file": picture()},
    "animation": {"file": picture()},
    "braille-file": {"file": b",HELLO"},
    "haptic-file": {"file": TAP},
    "sound": {"file": CLICK},
    "drawing": {
        "file": b'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9"><path d="M0 0L9 9" stroke="red"/></svg>'
    },
}
DEFAULTS = [(name, NEEDED.get(name, {})) for name in PATTERNS]
LOW = [(name, {"height_um": 10}) for name in ("all", "checker", "edge")]


@pytest.mark.parametrize("display", ["display-437", "display-1511"])
@pytest.mark.parametrize(("name", "given"), DEFAULTS + LOW, ids=lambda value: str(value) if type(value) is str else "")
def test_it_fits(display, name, given):
    model = DISPLAYS[display]
    sequence = build_pattern(name, given, model.config)
    planned, report = check_feasibility(model, sequence, *model.build_cold_state())
    assert report.fits, report.message
    assert set(planned.plan.reason) == {""}
