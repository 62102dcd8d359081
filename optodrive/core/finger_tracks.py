"""Where fingertips will be: a constant-velocity Kalman filter for each, from the places that a tracker reports.

Each axis has a place and a velocity, which a white acceleration changes (Bar-Shalom, Li and Kirubarajan, Estimation
with Applications to Tracking and Navigation, 2001, section 6.2.2). Its density is that of a hand that changes its speed
by ACCELERATION_M_PER_S2 for CHANGE_S at a time. A finger whose place is GATE standard deviations from the expected one
has jumped, and its track begins anew. A finger that stays within REST_M of the mean of its places rests: it is expected
there, because the filter's velocity, which follows a hand within CHANGE_S, is mostly noise then.
"""

from collections.abc import Sequence
from math import exp, hypot, sqrt
from typing import NamedTuple

from optodrive.core.types.fingers import FingerPlace

ACCELERATION_M_PER_S2, CHANGE_S = 1.0, 0.1
NOISE_M = 5e-4
"""Standard deviation of a reported place, per axis."""
FIRST_SPEED_M_PER_S = 0.1
"""Standard deviation of the unknown velocity of a new finger, per axis."""
GATE = 6.0
REST_M, REST_S = 2.0 * NOISE_M, 0.1
"""Distance from the mean of the latest places within which a finger rests, and the time constant of that mean."""
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


class _Track(NamedTuple):
    """State of a fingertip at a time. Numbers, because arrays of two take ten times as long.

    place_m2, cross_m2_per_s, speed_m2_per_s2: covariance of place and velocity, the same for both axes
    mean_x_m, mean_y_m: exponential mean of the reported places
    """

    at_s: float
    x_m: float
    y_m: float
    x_m_per_s: float
    y_m_per_s: float
    place_m2: float
    cross_m2_per_s: float
    speed_m2_per_s2: float
    radius_m: float
    mean_x_m: float
    mean_y_m: float


class FingerTracks:
    """The fingertips of one tracker. Times are of one clock, and do not decrease."""

    def __init__(self) -> None:
        self._tracks: dict[int, _Track] = {}

    def update(self, at_s: float, places: Sequence[FingerPlace]) -> None:
        """Take the places of all fingertips at a time. One that is missing has been lifted."""
        self._tracks = {place.number: self._continue(at_s, place) for place in places}

    def _continue(self, at_s: float, place: FingerPlace) -> _Track:
        earlier = self._tracks.get(place.number)
        if earlier is not None:
            track = _extrapolate(earlier, at_s)
            variance_m2 = track.place_m2 + NOISE_M**2
            x_m, y_m = place.x_m - track.x_m, place.y_m - track.y_m
            if hypot(x_m, y_m) <= GATE * sqrt(variance_m2):
                of_place, of_speed_per_s = track.place_m2 / variance_m2, track.cross_m2_per_s / variance_m2
                of_mean = 1.0 - exp((earlier.at_s - at_s) / REST_S)
                return _Track(
                    at_s,
                    track.x_m + of_place * x_m,
                    track.y_m + of_place * y_m,
                    track.x_m_per_s + of_speed_per_s * x_m,
                    track.y_m_per_s + of_speed_per_s * y_m,
                    track.place_m2 - of_place * track.place_m2,
                    track.cross_m2_per_s - of_place * track.cross_m2_per_s,
                    track.speed_m2_per_s2 - of_speed_per_s * track.cross_m2_per_s,
                    place.radius_m,
                    track.mean_x_m + of_mean * (place.x_m - track.mean_x_m),
                    track.mean_y_m + of_mean * (place.y_m - track.mean_y_m),
                )
        x_m, y_m, radius_m = place.x_m, place.y_m, place.radius_m
        return _Track(at_s, x_m, y_m, 0.0, 0.0, NOISE_M**2, 0.0, FIRST_SPEED_M_PER_S**2, radius_m, x_m, y_m)

    def predict(self, at_s: float) -> tuple[PredictedFinger, ...]:
        """Return the fingertips at a later time."""
        predicted = []
        for number, earlier in self._tracks.items():
            track = _extrapolate(earlier, at_s)
            margin_m = min(MARGIN_MAX_M, MARGIN_SIGMAS * sqrt(track.place_m2))
            rests = hypot(earlier.x_m - earlier.mean_x_m, earlier.y_m - earlier.mean_y_m) <= REST_M
            place_m = (track.mean_x_m, track.mean_y_m) if rests else (track.x_m, track.y_m)
            predicted.append(PredictedFinger(number, *place_m, track.radius_m, margin_m))
        return tuple(predicted)


def _extrapolate(track: _Track, at_s: float) -> _Track:
    """Return a track at a later time."""
    time_s = max(0.0, at_s - track.at_s)
    density = ACCELERATION_M_PER_S2**2 * CHANGE_S
    place_m2, cross_m2_per_s, speed_m2_per_s2 = track.place_m2, track.cross_m2_per_s, track.speed_m2_per_s2
    return track._replace(
        at_s=at_s,
        x_m=track.x_m + time_s * track.x_m_per_s,
        y_m=track.y_m + time_s * track.y_m_per_s,
        place_m2=place_m2 + time_s * (2.0 * cross_m2_per_s + time_s * (speed_m2_per_s2 + density * time_s / 3.0)),
        cross_m2_per_s=cross_m2_per_s + time_s * (speed_m2_per_s2 + density * time_s / 2.0),
        speed_m2_per_s2=speed_m2_per_s2 + density * time_s,
    )
