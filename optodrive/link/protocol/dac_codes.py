"""Conversion between mirror angles and DAC codes."""

from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class BipolarDac:
    """Digital-to-analogue converter whose centre code is angle 0."""

    bits: int

    @property
    def centre(self) -> int:
        """Code of angle 0."""
        return 1 << (self.bits - 1)

    @property
    def code_max(self) -> int:
        """Largest code."""
        return (1 << self.bits) - 1

    def to_codes(self, angle_rad: FloatArray, rad_per_code: float) -> IntArray:
        """Return the codes of mirror angles, any shape. Raise LocalProtocolError beyond the DAC's range."""
        codes = np.rint(angle_rad / rad_per_code).astype(np.int64) + self.centre
        if codes.size and (codes.min() < 0 or codes.max() > self.code_max):
            raise LocalProtocolError(f"codes {codes.min()} to {codes.max()} leave the DAC's range 0 to {self.code_max}")
        return codes

    def to_angles_rad(self, codes: IntArray, rad_per_code: float) -> FloatArray:
        """Return the mirror angles of codes, rad, any shape."""
        return np.asarray((codes - self.centre) * rad_per_code, dtype=np.float64)
