"""Display metres to mirror angles: an ideal f-theta lens, mirrors without distance between them."""

from dataclasses import dataclass

from optodrive.flow import FloatArray


@dataclass(frozen=True)
class IdealField:
    """x = f · 2 θ: the beam turns by twice the mirror's mechanical angle."""

    focal_length_m: float

    def mirror_rad(self, position_m: FloatArray) -> FloatArray:
        """Mechanical mirror angle, rad, for a position on the display, m; any shape, one axis."""
        return position_m / (2.0 * self.focal_length_m)

    def position_m(self, mirror_rad: FloatArray) -> FloatArray:
        """Position on the display, m, for a mechanical mirror angle, rad."""
        return mirror_rad * (2.0 * self.focal_length_m)
