"""Where fingertips will be: a constant-velocity Kalman filter for each, from the places that a tracker reports.

Each axis has a place and a velocity, which a white acceleration changes (Bar-Shalom, Li and Kirubarajan, Estimation
with Applications to Tracking and Navigation, 2001, section 6.2.2). Its density is that of a hand that changes its speed
by ACCELERATION_M_PER_S2 for CHANGE_S at a time. A finger whose place is GATE standard deviations from the expected one
has jumped, and its track begins anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, sqrt
from typing import NamedTuple

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.fingers import FingerPlace

ACCELERATION_M_PER_S2, CHANGE_S = 1.0, 0.1
NOISE_M = 5e-4
"""Standard deviation of a reported place, per axis."""
FIRST_SPEED_M_PER_S = 0.1
"""Standard deviation of the unknown velocity of a new finger, per axis."""
GATE = 6.0
MARGIN_SIGMAS, MARGIN_MAX_M = 2.0, 3e-3


class PredictedFinger(NamedTuple):
    """A fingertip at a later time.

    radius_m: of its contact; margin_m: by which its place may differ, two standard deviations or MARGIN_MAX_M
    """

    number: int
    x_m: float
    y_m: float
    radius_m: float
    margin_m: float


@dataclass
class _Track:
    """State of a fingertip at a time.

    state: [2, 2] place and velocity of x and y; covariance: [2, 2], the same for both axes
    """

    at_s: float
    state: FloatArray
    covariance: FloatArray
    radius_m: float


class FingerTracks:
    """The fingertips of one tracker. Times are of one clock, and do not decrease."""

    def __init__(self) -> None:
        self._tracks: dict[int, _Track] = {}

    def update(self, at_s: float, places: Sequence[FingerPlace]) -> None:
        """Take the places of all fingertips at a time. One that is missing has been lifted."""
        self._tracks = {place.number: self._continue(at_s, place) for place in places}

    def _continue(self, at_s: float, place: FingerPlace) -> _Track:
        measured_m = np.array([place.x_m, place.y_m])
        track = self._tracks.get(place.number)
        if track is not None:
            state, covariance = _extrapolate(track, at_s)
            variance_m2 = covariance[0, 0] + NOISE_M**2
            rest_m = measured_m - state[0]
            if hypot(*rest_m) <= GATE * sqrt(variance_m2):
                gain = covariance[:, 0] / variance_m2
                state = state + np.outer(gain, rest_m)
                covariance = covariance - np.outer(gain, covariance[0])
                return _Track(at_s, state, covariance, place.radius_m)
        return _Track(
            at_s, np.array([measured_m, [0.0, 0.0]]), np.diag([NOISE_M**2, FIRST_SPEED_M_PER_S**2]), place.radius_m
        )

    def predict(self, at_s: float) -> tuple[PredictedFinger, ...]:
        """Return the fingertips at a later time."""
        predicted = []
        for number, track in self._tracks.items():
            state, covariance = _extrapolate(track, at_s)
            margin_m = min(MARGIN_MAX_M, MARGIN_SIGMAS * sqrt(covariance[0, 0]))
            x_m, y_m = state[0].tolist()
            predicted.append(PredictedFinger(number, x_m, y_m, track.radius_m, margin_m))
        return tuple(predicted)


def _extrapolate(track: _Track, at_s: float) -> tuple[FloatArray, FloatArray]:
    """Return state and covariance of a track at a later time."""
    time_s = max(0.0, at_s - track.at_s)
    transition = np.array([[1.0, time_s], [0.0, 1.0]])
    density = ACCELERATION_M_PER_S2**2 * CHANGE_S
    noise = density * np.array([[time_s**3 / 3.0, time_s**2 / 2.0], [time_s**2 / 2.0, time_s]])
    return transition @ track.state, transition @ track.covariance @ transition.T + noise
