"""Read pictures as arrays with OpenCV, which only an extra installs."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optodrive.core.errors import MISSING, InputError
from optodrive.core.extras import import_extra
from optodrive.lab.calibration.camera.folder import PictureFolder

Image = NDArray[np.uint8] | NDArray[np.uint16]
MEDIAN_PICTURES_MAX = 15
"""Largest number of spot pictures whose median is the background; each spot lies elsewhere."""
MEDIAN_PICTURES_MIN = 3
"""Smallest number of spot pictures whose median is the background."""
MEDIAN_BLOCK_ROWS = 200
"""Rows per block of the median."""


def import_opencv() -> Any:
    """Import OpenCV. Raise InputError (missing_extra) if it is not installed."""
    return import_extra("cv2", "OpenCV", "camera")


def read_image(path: Path) -> Image:
    """Read a picture as [rows, columns], 8 or 16 bits.

    Of a colour picture it is the blue channel, which holds the beam.
    Raises InputError if OpenCV cannot read it.
    """
    cv2 = import_opencv()
    try:
        raw = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable picture") from None
    # Ignore the orientation tag: marks_px refer to the picture as the camera stored it.
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(raw, flags) if len(raw) else None
    except cv2.error:
        image = None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise InputError(str(path), "no picture", "a picture that OpenCV reads, 8 or 16 bits (PNG, TIFF, JPEG)")
    blue: Image = image if image.ndim == 2 else np.ascontiguousarray(image[..., 0])
    return blue


class PictureReader:
    """Reads the pictures of one folder, all of one size and depth."""

    def __init__(self, pictures: PictureFolder) -> None:
        self._first = pictures.grid_views[0]
        first = read_image(self._first)
        self.rows, self.columns = first.shape
        self._depth = first.dtype

    def __call__(self, path: Path) -> Image:
        """Read a picture. Raise InputError if its size or depth differs from the first."""
        image = read_image(path)
        if image.shape != (self.rows, self.columns):
            size = f"{image.shape[1]} × {image.shape[0]} pixels"
            raise InputError(str(path), size, f"{self.columns} × {self.rows}, as {self._first.name}")
        if image.dtype != self._depth:
            raise InputError(str(path), str(image.dtype), f"{self._depth}, as {self._first.name}")
        return image

    def read_background(self, pictures: PictureFolder) -> Image:
        """Return the plane without the beam: the dark picture, or the median of pictures of spots."""
        if pictures.dark is not None:
            return self(pictures.dark)
        if len(pictures.spot_pictures) < MEDIAN_PICTURES_MIN:
            found = f"{len(pictures.spot_pictures)} spots"
            raise InputError(
                f"{pictures.path}: dark", MISSING, f"a picture without the beam, required with only {found}"
            )
        chosen = np.unique(np.linspace(0, len(pictures.spot_pictures) - 1, MEDIAN_PICTURES_MAX).astype(int))
        stack = np.stack([self(pictures.spot_pictures[at].path) for at in chosen])
        background: Image = np.empty_like(stack[0])
        for first in range(0, self.rows, MEDIAN_BLOCK_ROWS):
            background[first : first + MEDIAN_BLOCK_ROWS] = np.median(
                stack[:, first : first + MEDIAN_BLOCK_ROWS].astype(np.float32), axis=0
            )
        return background
