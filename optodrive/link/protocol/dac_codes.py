"""Mirror angles and the codes of a converter."""

from dataclasses import dataclass

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class BipolarDac:
    """A digital-to-analogue converter of so many bits; its centre code is angle 0."""

    bits: int

    @property
    def centre(self) -> int:
        """The code of angle 0."""
        return 1 << (self.bits - 1)

    @property
    def code_max(self) -> int:
        """The largest code."""
        return (1 << self.bits) - 1

    def to_codes(self, angle_rad: FloatArray, rad_per_code: float) -> IntArray:
        """Mirror angle to codes; LocalProtocolError beyond the range. Any shape."""
        codes = np.rint(angle_rad / rad_per_code).astype(np.int64) + self.centre
        if codes.size and (codes.min() < 0 or codes.max() > self.code_max):
            raise LocalProtocolError(f"codes {codes.min()} to {codes.max()} leave the DAC's range 0 to {self.code_max}")
        return codes

    def to_angles_rad(self, codes: IntArray, rad_per_code: float) -> FloatArray:
        """Codes to mirror angle, rad. Any shape."""
        return np.asarray((codes - self.centre) * rad_per_code, dtype=np.float64)
