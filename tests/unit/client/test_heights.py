import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from displays import DISPLAYS
from optodrive.client.heights import (
    convert_to_pixels,
    encode_frame,
    encode_json,
    encode_target,
    interpolate_colour,
    render_png,
)
from optodrive.core.errors import InputError
from optodrive.device.config import build_pixel_layout
from optodrive.planning.effective_config import EffectiveConfig, build_effective_config
from optodrive.planning.stimuli.frame_json import parse_live_frame

LAYOUT = DISPLAYS["display-437"].layout


def test_the_layout_follows_from_the_daemons_configuration(any_display):
    sent = build_effective_config(any_display).model_dump_json()
    layout = build_pixel_layout(EffectiveConfig.model_validate_json(sent).display)
    for name in ("x_m", "y_m", "row", "column"):
        np.testing.assert_array_equal(getattr(layout, name), getattr(any_display.layout, name))


def test_mapping_array_and_grid_are_equivalent():
    by_place = np.full((21, 21), np.nan)
    by_place[LAYOUT.row[17], LAYOUT.column[17]] = 120.0
    by_index = np.zeros(437)
    by_index[17] = 120.0
    for given_um in ({17: 120.0}, by_index, by_index.tolist(), by_place):
        np.testing.assert_array_equal(convert_to_pixels(given_um, LAYOUT), by_index)
    assert encode_json(by_index) == {"17": 120.0}


@pytest.mark.parametrize(
    ("heights_um", "where"),
    [
        ({437: 1.0}, "heights_um"),
        ({"17": 1.0}, "heights_um"),
        ({17: "high"}, "heights_um"),
        ({17: -1.0}, r"heights_um\[17\]"),
        ({17: float("inf")}, r"heights_um\[17\]"),
        (np.zeros(436), "heights_um"),
        (np.zeros((21, 20)), "heights_um"),
        ("tall", "heights_um"),
        ([[1.0], [2.0, 3.0]], "heights_um"),
    ],
)
def test_invalid_heights_are_refused_in_one_line(heights_um, where):
    with pytest.raises(InputError, match=where) as refused:
        convert_to_pixels(heights_um, LAYOUT)
    assert "\n" not in str(refused.value)


@given(st.integers(0, 2**33), st.lists(st.floats(0, 6553.5), min_size=437, max_size=437))
def test_the_daemon_decodes_encoded_frames(number, heights_um):
    read, sequence = parse_live_frame(encode_frame(number, np.array(heights_um)), 0, 437)
    assert read == number % 2**32
    np.testing.assert_allclose(1e6 * sequence.frames[0].target_m, heights_um, atol=0.0501)


def test_a_height_that_exceeds_16_bits_is_refused():
    with pytest.raises(InputError, match=r"6553\.5"):
        encode_frame(0, convert_to_pixels({3: 6553.6}, LAYOUT))


def test_the_picture_has_its_size_and_its_lightness_increases(any_display):
    layout = any_display.layout
    written = render_png(layout, np.linspace(0.0, 50.0, len(layout)))
    width, height = struct.unpack(">II", written[16:24])
    assert 200 < width <= 700
    assert 40 < height <= 720
    lightness = [0.2126 * r + 0.7152 * g + 0.0722 * b for r, g, b in (interpolate_colour(k / 50) for k in range(51))]
    assert lightness == sorted(lightness)
    assert render_png(layout, np.zeros(len(layout)))[:4] == b"\x89PNG"


def test_a_frame_states_heights_or_intensities():
    by_height = encode_target({17: 120.0}, None, LAYOUT)
    assert by_height == {"target_um": {"17": 120.0}}
    assert encode_target(None, {17: 8}, LAYOUT) == {"intensity": {"17": 8.0}}
    for heights_um, intensity in ((None, None), ({17: 1.0}, {17: 1.0})):
        with pytest.raises(InputError, match="expected one of them"):
            encode_target(heights_um, intensity, LAYOUT)
    with pytest.raises(InputError, match=r"intensity\[17\]: got -1.0, expected an intensity ≥ 0"):
        encode_target(None, {17: -1.0}, LAYOUT)
