"""Gains and offsets from runs of hidden pixels.

They are tuned with seeds from 100 and tested on others.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from displays import DISPLAYS
from optodrive.core.errors import InputError
from optodrive.core.types.measurements import Run, Signal
from optodrive.lab.calibration.pixel_fit import Optics, PixelResponse, compute_response, fit_pixel
from optodrive.lab.calibration.pixel_map_fit import PixelMapFitter, compute_stats
from optodrive.lab.calibration.pixel_sweep import compute_pulse, list_aims

DISPLAY = DISPLAYS["display-16"]
CONFIG, OPTICS = DISPLAY.config, Optics.from_config(DISPLAY.config)
PULSES = np.array([[0.02, 0.005, 2.45, 3]])
T_S = np.arange(0.0, 0.12, 1e-3)
PREDICT = DISPLAY.build_cold_heat().simulate_displacement_m
PREDICTED_M = PREDICT(PULSES, 3, T_S)
SIGMA_M = 2e-6
AIM_MAX_M = (4e-3, 4e-3)
EACH_AIM = [(aim.x_m, aim.y_m) for aim in list_aims(CONFIG)]


def absorbed_fraction(aim_m, offset_m):
    """Return the fraction of a 1 × 0.5 mm focus on a 2 × 1.5 mm absorber, by counting points."""
    x, y = (
        np.abs(np.linspace(-half, half, 2001) + a - o)
        for half, a, o in zip((5e-4, 2.5e-4), aim_m, offset_m, strict=True)
    )
    return float(np.mean(x <= 1e-3) * np.mean(y <= 7.5e-4))


def simulate_run(gain, aim_m=(0.0, 0.0), offset_m=(0.0, 0.0), random=None, scale=1.0, pixel=3, zero_m=1e-5):
    noise_m = 0.0 if random is None else SIGMA_M * random.standard_normal(len(T_S))
    value_m = scale * (gain * absorbed_fraction(aim_m, offset_m) * PREDICTED_M + zero_m + noise_m)
    pulses = PULSES.copy()
    pulses[:, 3] = pixel
    attributes = {"aim_x_m": aim_m[0], "aim_y_m": aim_m[1]}
    return Run("r", 293.0, pulses, {"displacement_m": Signal(pixel, T_S, value_m)}, attributes)


def estimate_pixel(runs):
    responses = [compute_response("test", run, PREDICT, AIM_MAX_M) for run in runs]
    return fit_pixel([each for each in responses if each is not None], OPTICS)


def test_gain_and_offset_agree_with_their_stated_sigmas():
    random, off = np.random.default_rng(17), []
    for _ in range(150):
        gain, offset_m = random.uniform(0.5, 1.6), random.uniform(-1.5e-4, 1.5e-4, 2)
        pixel = estimate_pixel([simulate_run(gain, aim_m, offset_m, random) for aim_m in EACH_AIM])
        assert pixel.state == "measured"
        off.append(
            [(pixel.gain - gain) / pixel.gain_sigma, *(np.subtract(pixel.offset_m, offset_m) / pixel.offset_sigma_m)]
        )
        assert pixel.gain == pytest.approx(gain, rel=0.03)
        assert np.abs(np.subtract(pixel.offset_m, offset_m)).max() < 30e-6
    within = np.mean(np.abs(off) < 2.0, axis=0)
    assert 0.90 <= np.mean(np.abs(off) < 2.0) <= 0.98, within
    assert np.all(within > 0.88), within


def test_centred_aims_determine_the_gain_and_no_offset():
    pixel = estimate_pixel([simulate_run(0.8, random=np.random.default_rng(k)) for k in range(3)])
    assert pixel.gain == pytest.approx(0.8, abs=4 * pixel.gain_sigma)
    assert pixel.offset_m == (0.0, 0.0)
    assert np.all(np.isnan(pixel.offset_sigma_m))


def test_aims_across_one_edge_only_are_not_mistaken_for_a_low_gain():
    pixel = estimate_pixel([simulate_run(0.9, aim_m, (1e-4, 0.0)) for aim_m in ((0.0, 0.0), (-8e-4, 0.0))])
    assert pixel.gain == pytest.approx(0.9, rel=1e-3)
    assert pixel.offset_m == (0.0, 0.0)


def test_a_dead_pixel_is_distinguished_from_an_unmeasured_one():
    random = np.random.default_rng(3)
    assert estimate_pixel([simulate_run(0.03, aim_m, random=random) for aim_m in EACH_AIM]).state == "dead"
    loud = [response._replace(sigma=0.3) for response in [PixelResponse(3, 0.0, 0.0, 0.05, 0.0)] * 2]
    assert fit_pixel(loud, OPTICS).state == "not measured"
    assert estimate_pixel([]).state == "not measured"
    assert estimate_pixel([simulate_run(0.5, aim_m, random=random) for aim_m in EACH_AIM]).state == "measured"


@given(st.sets(st.integers(0, len(T_S) - 1), max_size=60), st.sets(st.integers(0, len(T_S) - 1), max_size=6))
def test_missing_samples_and_a_few_outliers_change_little(missing, wild):
    run = simulate_run(1.2, random=np.random.default_rng(1))
    value_m = run.signals["displacement_m"].value.copy()
    value_m[list(wild)] += 1e-3
    value_m[list(missing)] = np.nan
    answer = compute_response(
        "test", replace(run, signals={"displacement_m": Signal(3, T_S, value_m)}), PREDICT, AIM_MAX_M
    )
    assert answer is None or answer.ratio == pytest.approx(1.2, abs=6 * answer.sigma)


def test_too_few_samples_give_no_response():
    run = simulate_run(1.0)
    nothing = np.full(len(T_S), np.nan)
    nothing[:5] = 0.0
    assert (
        compute_response("t", replace(run, signals={"displacement_m": Signal(3, T_S, nothing)}), PREDICT, AIM_MAX_M)
        is None
    )
    assert compute_response("t", replace(run, signals={}), PREDICT, AIM_MAX_M) is None
    without_pulses = replace(run, pulses=np.zeros((0, 4)))
    assert compute_response("t", without_pulses, PREDICT, AIM_MAX_M) is None


@pytest.mark.parametrize(
    ("scale", "says"),
    [
        (1e3, "millimetres"),
        (1e6, "micrometres"),
        (25.4, "inches taken for millimetres"),
        (-1.0, "heights that increase upwards"),
        (-1e3, "heights that increase upwards; these look like millimetres"),
        (7.0, "× the model's heights at 16 pixels\", expected metres"),
        (1e-3, "a pixel that responds"),
        (0.0, "a pixel that responds"),
    ],
)
def test_wrong_units_of_a_whole_display_are_named(scale, says):
    random, responses = np.random.default_rng(4), PixelMapFitter(CONFIG, PREDICT)
    for pixel in range(16):
        gain = 0.0 if pixel == 5 else random.uniform(0.9, 1.1)
        responses.add_run("rec.h5", simulate_run(gain, random=random, scale=scale, pixel=pixel))
    with pytest.raises(InputError, match=r"rec\.h5: displacement_m: got ") as caught:
        responses.fit("rec.h5", "surroundings")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_impossible_pixel_or_aim_is_refused():
    responses = PixelMapFitter(CONFIG, PREDICT)
    with pytest.raises(InputError, match="pixel: got 16, expected a pixel of display-16, 0 to 15"):
        responses.add_run("rec.h5", simulate_run(1.0, pixel=16))
    for aim in (0.3, "left", float("nan")):
        bad = replace(simulate_run(1.0), attributes={"aim_x_m": aim})
        with pytest.raises(InputError, match=r"rec\.h5: /runs/r: aim_x_m: got"):
            responses.add_run("rec.h5", bad)
    with pytest.raises(InputError, match="heights of 0 pixels"):
        responses.fit("rec.h5", "surroundings")


def test_stats_list_dead_and_unmeasured_pixels():
    random, responses = np.random.default_rng(8), PixelMapFitter(CONFIG, PREDICT)
    for pixel in range(15):
        for aim_m in EACH_AIM:
            gain = 0.01 if pixel in (4, 9) else 1.0 + 0.01 * pixel
            responses.add_run("rec.h5", simulate_run(gain, aim_m, (5e-5, -1e-5), random, pixel=pixel))
    stats = compute_stats(responses.fit("rec.h5", "surroundings"), responses.run_count)
    assert stats["dead"] == [4, 9]
    assert stats["not_measured"] == [15]
    assert stats["measured"] == 13
    assert (stats["gain"]["min_pixel"], stats["gain"]["max_pixel"]) == (0, 14)
    assert stats["offset_um"]["x"]["median"] == pytest.approx(50, abs=10)


def test_light_beside_the_absorber_keeps_a_black_wall_below_its_cap():
    """A half-space of acrylic absorbs the whole focus. Rises of the PWM pulses are superposed."""
    laser = CONFIG.laser
    faint = [compute_pulse(CONFIG, aim) for aim in list_aims(CONFIG)[1:]]
    assert len(set(faint)) == 1
    width_s, power_w = faint[0]
    on_s, period_s = power_w / laser.max_power_w / laser.pwm_hz, 1.0 / laser.pwm_hz
    flux_w_per_m2 = laser.max_power_w / (laser.focus_width_m * laser.focus_height_m)
    begin_s = period_s * np.arange(round(width_s / period_s))
    end_s = begin_s[-1] + on_s
    root = np.sqrt(end_s - begin_s) - np.sqrt(np.maximum(0.0, end_s - begin_s - on_s))
    rise_k = 2.0 * flux_w_per_m2 / np.sqrt(np.pi * 0.19 * 1.75e6) * root.sum()
    room_k = CONFIG.limits.wall_max_c - CONFIG.ambient_c
    assert 0.4 * room_k < rise_k <= 0.8 * room_k
