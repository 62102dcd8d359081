"""Conversion between mirror angles, codes and the outputs of a DAC.

x and y are axes of the display everywhere but on the wire: codes along them become those of the outputs X and Y, as
scanner.swap_axes, invert_x and invert_y state the wiring, where points are encoded, and back where they are decoded.
"""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class DacScale:
    """Scale of a digital-to-analogue converter of the mirrors.

    CODE_MAX: largest code; CENTRE_CODE: that of angle 0
    swap_axes: output X has the mirror that moves the beam along y; invert_x, invert_y: outputs whose sign is turned
    """

    CODE_MAX: ClassVar[int]
    CENTRE_CODE: ClassVar[int]
    rad_per_code: float
    swap_axes: bool = field(default=False, kw_only=True)
    invert_x: bool = field(default=False, kw_only=True)
    invert_y: bool = field(default=False, kw_only=True)

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

    def to_outputs(self, x_codes: IntArray, y_codes: IntArray) -> tuple[IntArray, IntArray]:
        """Return the codes of the outputs X and Y for codes along x and y, any shape.

        Raise LocalProtocolError for the code whose inverse lies beyond the DAC's range.
        """
        outputs = (y_codes, x_codes) if self.swap_axes else (x_codes, y_codes)
        x, y = (self._invert(each, turned) for each, turned in zip(outputs, self._inverted, strict=True))
        if any(each.size and each.max() > self.CODE_MAX for each in (x, y)):
            raise LocalProtocolError(f"code 0 has no inverse in the DAC's range 0 to {self.CODE_MAX}")
        return x, y

    def to_axes(self, x_outputs: IntArray, y_outputs: IntArray) -> tuple[IntArray, IntArray]:
        """Return the codes along x and y of codes of the outputs X and Y, any shape."""
        x, y = (self._invert(each, on) for each, on in zip((x_outputs, y_outputs), self._inverted, strict=True))
        return (y, x) if self.swap_axes else (x, y)

    @property
    def _inverted(self) -> tuple[bool, bool]:
        return self.invert_x, self.invert_y

    def _invert(self, codes: IntArray, is_inverted: bool) -> IntArray:
        return 2 * self.CENTRE_CODE - codes if is_inverted else codes
