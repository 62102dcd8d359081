"""Prediction of fingertips, compared with hands that are simulated here."""

import numpy as np
import pytest

from optodrive.core.finger_tracks import MARGIN_MAX_M, FingerTracks
from optodrive.core.types.fingers import FingerPlace

RATE_HZ, AHEAD_S = 100.0, 0.06


def move_hand(rng, seconds, speed_m_per_s):
    """Return places [n, 2] of a finger that reads along a line with changing speed, at RATE_HZ."""
    count = int(seconds * RATE_HZ)
    aims = speed_m_per_s * np.repeat(rng.uniform(0.5, 1.5, count // 20 + 1), 20)[:count]
    speed, speeds = speed_m_per_s, []
    for each in aims:
        speed += (each - speed) * (1.0 - np.exp(-1.0 / (RATE_HZ * 0.08)))
        speeds.append(speed)
    x_m = np.cumsum(speeds) / RATE_HZ
    return np.column_stack([x_m, 0.001 * np.sin(8.0 * x_m / 0.05)])


def predict_errors(rng, places, noise_m, ahead_s=AHEAD_S):
    """Return the distances of predicted from true places, m, of the last known ones from them, and the margins."""
    tracks, errors, holds, margins = FingerTracks(), [], [], []
    steps = round(ahead_s * RATE_HZ)
    for k in range(len(places) - steps):
        seen = places[k] + rng.normal(0.0, noise_m, 2)
        tracks.update(k / RATE_HZ, [FingerPlace(4, *seen.tolist(), 0.005)])
        (finger,) = tracks.predict(k / RATE_HZ + ahead_s)
        if k > 20:
            errors.append(np.hypot(*(np.array([finger.x_m, finger.y_m]) - places[k + steps])))
            holds.append(np.hypot(*(seen - places[k + steps])))
            margins.append(finger.margin_m)
    return np.array(errors), np.array(holds), np.array(margins)


@pytest.mark.parametrize("speed_m_per_s", [0.02, 0.05, 0.1])
@pytest.mark.parametrize("seed", range(3))
def test_a_reading_finger_is_predicted_within_its_margin(speed_m_per_s, seed):
    rng = np.random.default_rng(seed)
    errors, holds, margins = predict_errors(rng, move_hand(rng, 10.0, speed_m_per_s), 3e-4)
    assert np.mean(errors <= margins) >= 0.95
    if speed_m_per_s >= 0.05:
        assert np.median(errors) < 0.6 * np.median(holds)


def test_a_steady_finger_without_noise_is_predicted_exactly():
    tracks = FingerTracks()
    for k in range(100):
        tracks.update(k / RATE_HZ, [FingerPlace(1, 1e-3 * k, -5e-4 * k, 0.004)])
    (finger,) = tracks.predict(1.05)
    assert (finger.x_m, finger.y_m) == pytest.approx((0.105, -0.0525), abs=1e-5)
    assert finger.radius_m == 0.004


def test_a_finger_that_lifts_or_jumps_begins_anew():
    tracks = FingerTracks()
    for k in range(50):
        tracks.update(k / RATE_HZ, [FingerPlace(1, 1e-3 * k, 0.0, 0.004), FingerPlace(2, 0.0, 0.0, 0.004)])
    assert [finger.number for finger in tracks.predict(0.5)] == [1, 2]
    tracks.update(0.5, [FingerPlace(1, -0.06, 0.01, 0.004)])
    (finger,) = tracks.predict(0.55)
    assert (finger.number, finger.x_m, finger.y_m) == (1, -0.06, 0.01)
    tracks.update(0.51, [])
    assert tracks.predict(0.52) == ()


def test_the_margin_grows_with_the_time_ahead_and_is_bounded():
    tracks = FingerTracks()
    for k in range(50):
        tracks.update(k / RATE_HZ, [FingerPlace(1, 1e-3 * k, 0.0, 0.004)])
    margins = [tracks.predict(0.49 + ahead_s)[0].margin_m for ahead_s in (0.0, 0.02, 0.05, 1.0)]
    assert margins == sorted(margins)
    assert margins[-1] == MARGIN_MAX_M
