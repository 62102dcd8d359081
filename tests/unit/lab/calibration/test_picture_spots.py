"""Detection of one spot in a picture, tuned with seeds from 1000."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optodrive.core.errors import InputError
from optodrive.lab.calibration.picture_spots import RIVAL_FRACTION_MAX, find_spot

ROWS, COLUMNS = 240, 320
Y, X = np.mgrid[:ROWS, :COLUMNS]
BACKGROUND_COUNTS = 20.0


def draw_blob(at, widths=(3.1, 1.9), turn=0.4):
    x, y = X - at[0], Y - at[1]
    along, across = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    return np.exp(-0.5 * ((along / widths[0]) ** 2 + (across / widths[1]) ** 2))


def take_picture(light, seed=0, noise=2.0, full=np.uint8):
    noisy = light + BACKGROUND_COUNTS + noise * np.random.default_rng(seed).standard_normal(light.shape)
    return np.clip(np.rint(noisy), 0, np.iinfo(full).max).astype(full)


DARK = take_picture(0.0 * X, seed=99)


def error_px(seen, at):
    return float(np.hypot(*(seen.centre_px - at)))


@settings(max_examples=40, deadline=None)
@given(
    at=st.tuples(st.floats(20, COLUMNS - 21), st.floats(20, ROWS - 21)),
    peak=st.floats(60, 220),
    widths=st.tuples(st.floats(1.2, 6), st.floats(1.2, 6)),
    seed=st.integers(0, 999),
)
def test_a_spot_of_any_shape_is_located_within_five_stated_sigmas(at, peak, widths, seed):
    seen = find_spot("it", take_picture(peak * draw_blob(at, widths), seed), DARK)
    assert error_px(seen, at) < min(0.25, max(0.05, 5.0 * seen.sigma_px))
    assert not seen.saturated_pixels


@pytest.mark.parametrize("times", [2, 10, 50])
def test_a_saturated_core_costs_no_accuracy_and_is_reported(times):
    for seed in range(5):
        at = np.random.default_rng([seed, times]).uniform(50, 150, 2)
        seen = find_spot("it", take_picture(250.0 * times * draw_blob(at), seed), DARK)
        assert seen.saturated_pixels > 5
        assert error_px(seen, at) < 0.05


def test_sixteen_bits_and_their_saturation():
    at = (101.3, 77.7)
    light = 3000.0 * draw_blob(at)
    twelve = np.minimum(take_picture(light * 2, noise=20.0, full=np.uint16), 4095)
    assert (
        find_spot("it", take_picture(light, noise=20.0, full=np.uint16), DARK.astype(np.uint16)).saturated_pixels == 0
    )
    seen = find_spot("it", twelve, DARK.astype(np.uint16))
    assert seen.saturated_pixels > 5
    assert error_px(seen, at) < 0.05


@pytest.mark.parametrize("share", [0.05, 0.2, 0.4])
def test_a_weaker_reflection_is_ignored(share):
    for seed in range(10):
        at = np.random.default_rng([seed, 7]).uniform(60, 180, 2)
        turned = 2.0 * np.pi * seed / 10.0
        other = at + 40.0 * np.array([np.cos(turned), np.sin(turned)])
        seen = find_spot("it", take_picture(200.0 * (draw_blob(at) + share * draw_blob(other)), seed), DARK)
        assert error_px(seen, at) < 0.06
        assert seen.rival_fraction < RIVAL_FRACTION_MAX


def test_a_reflection_that_touches_the_spot_increases_its_sigma():
    at = np.array((120.2, 90.4))
    alone = find_spot("it", take_picture(180.0 * draw_blob(at)), DARK)
    touched = find_spot("it", take_picture(180.0 * (draw_blob(at) + 0.3 * draw_blob(np.add(at, (8.0, 2.0))))), DARK)
    assert touched.sigma_px > 5.0 * alone.sigma_px
    assert error_px(touched, at) < 4.0 * touched.sigma_px


def test_the_stated_sigma_matches_the_effect_of_noise():
    at = np.array((120.2, 90.4))
    seen = [find_spot("it", take_picture(60.0 * draw_blob(at), seed, noise=4.0), DARK) for seed in range(40)]
    off = np.array([each.centre_px - at for each in seen])
    stated = np.sqrt(np.mean([each.sigma_px**2 for each in seen]))
    assert 0.7 < np.sqrt((off**2).mean()) / stated < 1.3


def test_hot_pixels_and_a_change_of_ambient_light_are_not_spots():
    at = (120.2, 90.4)
    shown = take_picture(150.0 * draw_blob(at) + 12.0)
    shown[30, 40] = shown[200, 300] = 255
    assert error_px(find_spot("it", shown, DARK), at) < 0.05


REFUSED = {
    "none": (0.0 * X, "it: got 'nothing brighter than"),
    "alike": (
        200.0 * (draw_blob((80, 80)) + 0.9 * draw_blob((200, 150))),
        "two similar spots, at 80 80 and 200 150 px",
    ),
    "both saturated": (900.0 * (draw_blob((80, 80)) + draw_blob((200, 150))), "two similar spots"),
    "cut": (200.0 * draw_blob((1.0, 120.0)), "cut by the picture's edge"),
}


def test_a_spot_on_the_edge_of_a_black_square_is_named():
    squares = np.where((X // 40 + Y // 40) % 2, 1.0, 0.1)
    dark = take_picture(100.0 * squares, 98)
    on_edge = take_picture(100.0 * squares + 120.0 * squares * draw_blob((120.0, 100.0)))
    with pytest.raises(InputError, match="on a pattern of"):
        find_spot("it", on_edge, dark)
    inside = take_picture(100.0 * squares + 120.0 * squares * draw_blob((140.3, 100.2)))
    assert error_px(find_spot("it", inside, dark), (140.3, 100.2)) < 0.1


@pytest.mark.parametrize("case", sorted(REFUSED))
def test_a_picture_without_a_single_spot_is_refused_with_the_cause(case):
    light, named = REFUSED[case]
    with pytest.raises(InputError, match=named):
        find_spot("it", take_picture(light), DARK)
