"""Conversion between mirror angles and DAC codes."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class DacScale:
    """Scale of a digital-to-analogue converter of the mirrors.

    CODE_MAX: largest code; CENTRE_CODE: that of angle 0
    """

    CODE_MAX: ClassVar[int]
    CENTRE_CODE: ClassVar[int]
    rad_per_code: float

    def __init_subclass__(cls, bits: int) -> None:
        cls.CODE_MAX, cls.CENTRE_CODE = (1 << bits) - 1, 1 << (bits - 1)

    def to_codes(self, angle_rad: FloatArray) -> IntArray:
        """Return the codes of mirror angles, any shape. Raise LocalProtocolError beyond the DAC's range."""
        codes = np.rint(angle_rad / self.rad_per_code).astype(np.int64) + self.CENTRE_CODE
        if codes.size and (codes.min() < 0 or codes.max() > self.CODE_MAX):
            raise LocalProtocolError(f"codes {codes.min()} to {codes.max()} leave the DAC's range 0 to {self.CODE_MAX}")
        return codes

    def to_angles_rad(self, codes: IntArray) -> FloatArray:
        """Return the mirror angles of codes, rad, any shape."""
        return np.asarray((codes - self.CENTRE_CODE) * self.rad_per_code, dtype=np.float64)
