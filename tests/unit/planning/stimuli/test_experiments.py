"""Times, places and powers of the pulses in the paper's six experiments."""

import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config
from optodrive.planning.stimuli.experiments import (
    build_intensity,
    build_linear_motion,
    build_localisation,
    build_rotation,
    build_temporal_pattern,
    build_two_fingers,
)
from optodrive.planning.stimuli.pixel_lattice import Lattice
from optodrive.planning.stimuli.refresh import sequence_end_s
from optodrive.planning.stimuli.train_json import check_trains

CONFIG = load_config("display-437")
LAYOUT = Lattice.from_config(CONFIG).layout
MIDDLE = 218


def pulses(sequence):
    """Return start, width, power and pixel of every pulse, in order of time."""
    check_trains(sequence.trains, "trains", CONFIG)
    rows = [(at, t.pulse_width_s, t.power_w, t.pixel) for t in sequence.trains for at in t.pulse_starts_s()]
    return np.array(sorted(rows)).T


def places(pixels, centre=MIDDLE):
    """Return (rows up, columns right) from the centre."""
    pixels = pixels.astype(int)
    return list(
        zip(LAYOUT.row[pixels] - LAYOUT.row[centre], LAYOUT.column[pixels] - LAYOUT.column[centre], strict=True)
    )


@pytest.mark.parametrize(
    ("direction", "path"),
    [
        ("right", [(0, -1), (0, 0), (0, 1)]),
        ("left", [(0, 1), (0, 0), (0, -1)]),
        ("up", [(-1, 0), (0, 0), (1, 0)]),
        ("down", [(1, 0), (0, 0), (-1, 0)]),
    ],
)
def test_experiment_1_moves_over_three_pixels_twice(direction, path):
    start_s, width_s, power_w, pixel = pulses(build_linear_motion(CONFIG, "e", direction, None))
    slot_s = [0.0, 0.3, 0.6, 1.4, 1.7, 2.0]
    assert start_s == pytest.approx([slot + k * 0.08 for slot in slot_s for k in range(4)])
    assert width_s == pytest.approx(0.02)
    assert power_w == pytest.approx(2.45)
    assert places(pixel) == [place for place in path * 2 for _ in range(4)]


@pytest.mark.parametrize(("speed", "slot_s", "each"), [("16", 0.2, 2), ("32", 0.1, 1), ("64", 0.05, 1)])
def test_experiment_2_turns_from_the_bottom_left(speed, slot_s, each):
    start_s, width_s, _, pixel = pulses(build_rotation(CONFIG, "e", "cw", speed, None))
    assert start_s == pytest.approx([k * slot_s + j * 0.096 for k in range(8) for j in range(each)])
    assert width_s == pytest.approx(0.025)
    assert np.all(start_s + width_s <= np.repeat(np.arange(1, 9), each) * slot_s + 1e-9)
    clockwise = places(pixel[::each])
    assert clockwise == [(-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0)]
    counter = places(pulses(build_rotation(CONFIG, "e", "ccw", speed, None))[3][::each])
    assert counter == [(-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1)]


@pytest.mark.parametrize(("target", "place"), [(1, (1, -1)), (3, (1, 1)), (5, (0, 0)), (8, (-1, 0)), (9, (-1, 1))])
def test_experiment_3_shows_a_reference_and_a_target(target, place):
    start_s, width_s, _, pixel = pulses(build_localisation(CONFIG, "e", target, None))
    assert start_s == pytest.approx([slot + k * 0.05 for slot in (0.0, 1.25) for k in range(10)])
    assert width_s == pytest.approx(0.025)
    assert places(pixel) == [(0, 0)] * 10 + [place] * 10


@pytest.mark.parametrize(("level", "power"), [(1, 0.5), (2, 0.75), (5, 1.5), (8, 2.25), (9, 2.45)])
def test_experiment_4_has_nine_powers(level, power):
    start_s, width_s, power_w, pixel = pulses(build_intensity(CONFIG, "e", level, None))
    assert start_s == pytest.approx(0.05 * np.arange(20))
    assert width_s == pytest.approx(0.025)
    assert power_w == pytest.approx(power)
    assert set(pixel) == {MIDDLE}


@pytest.mark.parametrize("kind", ["slow", "fast"])
@pytest.mark.parametrize("oddball", [1, 2, 3])
def test_experiment_5_has_one_odd_stimulus(oddball, kind):
    sequence = build_temporal_pattern(CONFIG, "e", oddball, kind, 0.5, None)
    start_s, width_s, _, pixel = pulses(sequence)
    assert set(pixel) == {MIDDLE}
    counts = {"slow": (6, 0.035), "fast": (20, 0.010)}
    other = "fast" if kind == "slow" else "slow"
    for k, stimulus in enumerate((0.0, 0.9, 1.8), start=1):
        count, wide_s = counts[kind if k == oddball else other]
        inside = (start_s >= stimulus - 1e-9) & (start_s < stimulus + 0.4)
        assert start_s[inside] == pytest.approx(stimulus + 2 * wide_s * np.arange(count))
        assert width_s[inside] == pytest.approx(wide_s)
    assert len(start_s) == 2 * counts[other][0] + counts[kind][0]


def test_experiment_5_accepts_another_pause():
    assert sequence_end_s(build_temporal_pattern(CONFIG, "e", 1, "slow", 0.0, None)) == pytest.approx(0.8 + 0.39)


@pytest.mark.parametrize("digits", ["2-3", "2-4", "2-5", "3-4", "3-5", "4-5"])
def test_experiment_6_interleaves_two_fingers(digits):
    start_s, width_s, power_w, pixel = pulses(build_two_fingers(CONFIG, "e", digits, None))
    step_s = start_s[1] - start_s[0]
    assert 0.0155 < step_s < 0.017  # time to settle after a move from finger to finger
    assert start_s == pytest.approx(step_s * np.arange(40))
    assert width_s == pytest.approx(0.015)
    assert power_w == pytest.approx(2.45)
    pixel = pixel.astype(int)
    assert np.array_equal(pixel, np.tile(pixel[:8], 5))
    first, second = pixel[:8:2], pixel[1:8:2]
    for square in (first, second):
        assert len(set(square)) == 4
        assert np.ptp(LAYOUT.row[square]) == np.ptp(LAYOUT.column[square]) == 1
    assert LAYOUT.x_m[second].min() - LAYOUT.x_m[first].max() > 10e-3


def test_a_finger_keeps_its_place_whatever_its_partner():
    with_3 = set(pulses(build_two_fingers(CONFIG, "e", "2-3", None))[3][:8:2])
    with_5 = set(pulses(build_two_fingers(CONFIG, "e", "2-5", None))[3][:8:2])
    assert with_3 == with_5


@pytest.mark.parametrize("name", ["display-357", "display-437", "display-1511"])
@pytest.mark.parametrize("digits", ["2-3", "2-5", "4-5"])
def test_a_hand_fits_on_the_large_displays(name, digits):
    assert len(pulses(build_two_fingers(load_config(name), "e", digits, None))[0]) == 40


def test_another_centre_moves_the_stimulus():
    centre = int(Lattice.from_config(CONFIG).pixel_at(5, 7))
    pixel = pulses(build_rotation(CONFIG, "e", "cw", "64", centre))[3]
    assert places(pixel, centre)[0] == (-1, -1)


@pytest.mark.parametrize(
    ("build", "name"),
    [
        (lambda config: build_linear_motion(config, "e", "up", None), "display-1"),
        (lambda config: build_rotation(config, "e", "cw", "16", None), "display-1"),
        (lambda config: build_localisation(config, "e", 1, None), "display-1"),
        (lambda config: build_two_fingers(config, "e", "2-3", None), "display-16"),
        (lambda config: build_localisation(config, "e", 1, 0), "display-16"),
    ],
)
def test_a_display_too_small_is_refused_with_the_requirement(build, name):
    with pytest.raises(InputError, match=rf"e: centre: got \d+, expected a pixel with .* \({name} is") as caught:
        build(load_config(name))
    assert caught.value.code == "does_not_fit"


def test_a_missing_corner_is_no_pixel():
    with pytest.raises(InputError, match="eight pixels"):
        build_rotation(CONFIG, "e", "cw", "16", int(Lattice.from_config(CONFIG).pixel_at(1, 1)))


def test_one_pixel_is_enough_for_experiments_4_and_5():
    config = load_config("display-1")
    assert len(pulses(build_intensity(config, "e", 9, None))[0]) == 20
    assert len(pulses(build_temporal_pattern(config, "e", 2, "fast", 0.5, None))[0]) == 32
