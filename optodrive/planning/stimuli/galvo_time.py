"""Shortest time of a picture's moves under the galvo cap."""

from math import sqrt

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.device.config import Config
from optodrive.planning.batch_limiter import PAUSE_FRACTION_MAX
from optodrive.planning.budget_setup import build_galvo_model
from optodrive.planning.limiter.galvo_load import move_energy, ringing_envelope_factor


class GalvoTimeEstimator:
    """Estimates the time over which a picture's moves must be spread, if it is drawn again and again."""

    def __init__(self, config: Config) -> None:
        self._galvo = build_galvo_model(config)
        cap_rad2_per_s4 = config.limits.galvo_acceleration_rms_max_rad_per_s2**2
        # The limiter always counts one more move, of any length.
        self._available_rad2_per_s4 = cap_rad2_per_s4 - move_energy(self._galvo, 1e9) / self._galvo.averaging_s

    def compute_time_s(self, dx_rad: FloatArray, dy_rad: FloatArray, beam_time_s: float) -> float:
        """Return the time of the moves, with room for a last pause, s, or beam_time_s if the moves fit within it.

        dx_rad, dy_rad: [n] moves of the two mirrors; beam_time_s: time of the pulses and of settling
        """
        if self._available_rad2_per_s4 <= 0.0:
            return beam_time_s
        envelope = ringing_envelope_factor(self._galvo, beam_time_s / max(1, len(dx_rad)))
        load_rad2_per_s3 = max(self._sum_energy(dx_rad, envelope), self._sum_energy(dy_rad, envelope))
        time_s = load_rad2_per_s3 / self._available_rad2_per_s4
        return time_s + PAUSE_FRACTION_MAX * self._galvo.averaging_s if time_s > beam_time_s else beam_time_s

    def _sum_energy(self, moves_rad: FloatArray, envelope: float) -> float:
        """Return an upper bound on the integral of a² over moves of one mirror, of which each adds to a ringing one."""
        roots, ringing = np.zeros(len(moves_rad)), 0.0
        for position, move_rad in enumerate(moves_rad.tolist()):
            ringing = sqrt(move_energy(self._galvo, abs(move_rad) + self._galvo.rad_per_code)) + envelope * ringing
            roots[position] = ringing
        return float((roots**2).sum())
