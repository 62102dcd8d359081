"""Stimuli that would show nothing by mistake are refused: blank ones, and heights in metres."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from optodrive.core.errors import InputError, RefusedError
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.stimuli.frame_json import parse_targets_m
from optodrive.planning.stimuli.images import build_animation, build_image
from optodrive.planning.stimuli.pattern_registry import build_pattern
from optodrive.planning.stimuli.sequence_file import parse_sequence

CONFIG = load_config("display-16")


def _encode(*pictures, kind="PNG"):
    buffer = BytesIO()
    pictures[0].save(buffer, kind, save_all=len(pictures) > 1, append_images=pictures[1:])
    return buffer.getvalue()


WHITE, BLACK, CLEAR = (255, 255, 255, 255), (0, 0, 0, 255), (255, 255, 255, 0)
SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9">{}</svg>'
LINE = '<line x1="{0}" y1="1" x2="{0}" y2="8" stroke="black" stroke-width="0.3"/>'


def _draw(colour, spot=None, size=(100, 100)):
    picture = Image.new("RGBA", size, colour)
    if spot:
        picture.putpixel(spot, WHITE)
    return _encode(picture)


NOTHING = {
    "black": ("image", {"file": _draw(BLACK)}, "black everywhere"),
    "white, inverted": ("image", {"file": _draw(WHITE), "invert": True}, "white everywhere"),
    "transparent": ("image", {"file": _draw(CLEAR)}, "wholly transparent"),
    "transparent, inverted": ("image", {"file": _draw(CLEAR), "invert": True}, "wholly transparent"),
    "one sample of many": ("image", {"file": _draw(BLACK, (100, 100), (200, 200))}, "reaches 4 % of full height"),
    "dark": ("image", {"file": _draw((5, 5, 5, 255))}, "reaches 4 % of full height, the highest is 2 %"),
    "in a corner without a pixel": (
        "image",
        {"file": _draw(BLACK, (0, 0), (23, 23))},
        "where the display has no pixel",
    ),
    "animation": ("animation", {"file": _encode(*(Image.new("L", (8, 8), 0),) * 2)}, "black everywhere"),
    "drawing of text": ("drawing", {"file": SVG.format("<text>a</text>").encode()}, "it has no shape"),
    "white drawing": ("drawing", {"file": SVG.format(LINE.format(4).replace("black", "#fff")).encode()}, "is white"),
    "line outside": ("drawing", {"file": SVG.format(LINE.format(40)).encode()}, "outside its viewBox"),
    "drawn where no pixel is": (
        "drawing",
        {"file": SVG.format('<path d="M0 0.1H0.1" stroke="black" stroke-width="0.1"/>').encode()},
        "where the display has no pixel",
    ),
    "blank text": ("text", {"text": "  "}, "it is blank"),
    "blank braille file": ("braille-file", {"file": b"   \n\f \n"}, "all its pages are blank"),
}


@pytest.mark.parametrize("name", NOTHING)
def test_a_stimulus_that_raises_nothing_is_refused_with_the_reason(name):
    pattern, given, reason = NOTHING[name]
    with pytest.raises(InputError, match="got a stimulus that raises nothing: ") as caught:
        build_pattern(pattern, given, load_config("display-437"))
    assert caught.value.code == "raises_nothing"
    assert reason in str(caught.value)


@pytest.mark.parametrize("invert", [False, True])
@pytest.mark.parametrize("build", [build_image, build_animation])
def test_a_picture_of_one_raised_pixel_is_none_of_these(build, invert):
    background, raised = (255, 0) if invert else (0, 255)
    picture = Image.new("L", (16, 16), background)
    picture.putpixel((8, 8), raised)
    sequence = build(CONFIG, "t", _encode(picture), 1e-4, 1.0, invert)
    assert sum(int(target_m > 0.0) for target_m in sequence.frames[0].target_m) >= 1


@pytest.mark.parametrize("targets", [{}, {"3": 0}, [0] * 16])
@pytest.mark.parametrize("key", ["target_um", "intensity"])
def test_frames_of_zeros_are_refused_and_pauses_between_frames_are_not(targets, key):
    blank = {"show_at_s": 0, "duration_s": 1, key: targets}
    with pytest.raises(InputError, match="raises nothing: every target is 0") as caught:
        parse_sequence({"frames": [blank, blank | {"show_at_s": 2}]}, CONFIG, "f")
    assert caught.value.code == "raises_nothing"
    assert len(parse_sequence({"frames": [blank, blank | {"show_at_s": 2, key: {"3": 5}}]}, CONFIG, "f").frames) == 2
    train = {"pixel": 1, "start_s": 0, "duration_s": 1, "pulse_width_s": 0.02, "gap_s": 0.06, "power_w": 1.0}
    assert parse_sequence({"frames": [blank], "trains": [train]}, CONFIG, "f").trains


def _plan(display, sequence, **options):
    return check_feasibility(display, sequence, *display.build_cold_state(), **options)


def _nothing_by_plan():
    """Displays on which a frame of pixel 3 raises nothing, with the reason."""
    display = DisplayModel.from_config(CONFIG)
    dead = np.arange(16) == 3
    yield replace(display, dead=dead), "every requested pixel is dead"
    # A period at the threshold would raise the pixel by more than twice the target.
    weak = CONFIG.model_copy(update={"laser": CONFIG.laser.model_copy(update={"threshold_w": 2.44, "pwm_hz": 250.0})})
    yield DisplayModel.from_config(weak), "every pulse is weaker than laser.threshold_w"


def test_a_plan_that_raises_nothing_does_not_fit():
    frame = TactileFrame("one", 0.0, 1.0, np.where(np.arange(16) == 3, 1e-5, 0.0))
    for display, reason in _nothing_by_plan():
        _, report = _plan(display, FrameSequence((frame,)))
        assert (report.fits, report.reason) == (False, "nothing_raised")
        assert report.message == f"no pixel is raised: {reason}"
        with pytest.raises(RefusedError, match=reason) as refused:
            _plan(display, FrameSequence((frame,)), policy="refuse")
        assert refused.value.feasibility["reason"] == "nothing_raised"
    display = replace(DisplayModel.from_config(CONFIG), dead=np.arange(16) == 3)
    several = replace(frame, target_m=np.where(np.arange(16) < 4, 1e-5, 0.0))
    assert _plan(display, FrameSequence((several,)))[1].fits


@pytest.mark.parametrize("value", [5e-5, 3e-4, 0.0099])
def test_heights_in_metres_are_refused(value):
    with pytest.raises(InputError, match="likely in m"):
        parse_targets_m({"1": 50, "3": value}, "f", {"1": 0, "3": 1})
    assert parse_targets_m([0, 0.01], "f", {"1": 0, "3": 1}).tolist() == [0.0, 1e-8]


@pytest.mark.parametrize(
    ("power_w", "likely"),
    [
        (2.5, "; this value is just beyond it, or in mW"),
        (4.9, "; this value is just beyond it, or in mW"),
        (2450.0, "; this value is likely in mW or µW"),
    ],
)
def test_a_power_just_above_the_lasers_may_be_too_large(power_w, likely):
    train = {"pixel": 1, "start_s": 0, "duration_s": 1, "pulse_width_s": 0.02, "gap_s": 0.06, "power_w": power_w}
    with pytest.raises(InputError, match=r"at most laser\.max_power_w = 2\.45 W") as refused:
        parse_sequence({"trains": [train]}, CONFIG, "t")
    assert str(refused.value).partition(" = 2.45 W")[2] == likely


@pytest.mark.parametrize(("value", "likely"), [("1001", False), ("1999", False), ("200000", True)])
def test_a_parameter_just_above_its_range_may_be_too_large(value, likely):
    with pytest.raises(InputError) as refused:
        build_pattern("pixel", {"height_um": value}, CONFIG)
    assert ("likely in nm" in str(refused.value)) == likely
