"""Stimuli that would show nothing by mistake are refused: transparent pictures, and heights in metres."""

from io import BytesIO

import pytest
from PIL import Image

from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config
from optodrive.planning.stimuli.frame_json import parse_targets_m
from optodrive.planning.stimuli.images import build_animation, build_image
from optodrive.planning.stimuli.pattern_registry import build_pattern
from optodrive.planning.stimuli.sequence_file import parse_sequence

CONFIG = load_config("display-16")


def _encode(*pictures, kind="PNG"):
    buffer = BytesIO()
    pictures[0].save(buffer, kind, save_all=len(pictures) > 1, append_images=pictures[1:])
    return buffer.getvalue()


@pytest.mark.parametrize("invert", [False, True])
def test_a_wholly_transparent_picture_is_refused_and_a_dark_one_is_not(invert):
    clear, white = Image.new("RGBA", (8, 8), (255, 255, 255, 0)), Image.new("RGBA", (8, 8), (255, 255, 255, 255))
    black = Image.new("RGBA", (8, 8), (0, 0, 0, 255))
    for build, more in ((build_image, (1.0, invert)), (build_animation, (None, invert))):
        with pytest.raises(InputError, match="transparent") as caught:
            build(CONFIG, "t", _encode(clear), 1e-4, *more)
        assert caught.value.code == "bad_picture"
        for picture in (black, white):
            assert build(CONFIG, "t", _encode(picture), 1e-4, *more).frames
    assert build_animation(CONFIG, "t", _encode(clear, white, black), 1e-4, None, invert).frames


@pytest.mark.parametrize("name", ["image", "animation"])
@pytest.mark.parametrize("invert", [False, True])
def test_a_pattern_that_raises_nothing_is_refused_in_one_line(name, invert):
    black, white = (_encode(Image.new("L", (8, 8), grey)) for grey in (0, 255))
    raised, left = (black, white) if invert else (white, black)
    assert build_pattern(name, {"file": raised, "invert": invert}, CONFIG).frames
    with pytest.raises(InputError, match=r"a stimulus that raises nothing, expected .* dark ones with invert=true"):
        build_pattern(name, {"file": left, "invert": invert}, CONFIG)


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
