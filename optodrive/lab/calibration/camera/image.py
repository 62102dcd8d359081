"""Pictures as arrays, by OpenCV, which only an extra installs."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optodrive.core.errors import InputError
from optodrive.lab.calibration.camera.folder import PictureFolder

Image = NDArray[np.uint8] | NDArray[np.uint16]
MEDIAN_PICTURES_MAX = 15
"""The plane without the beam is the median of so many pictures of spots, each of which lies elsewhere."""
MEDIAN_PICTURES_MIN = 3
MEDIAN_BLOCK_ROWS = 200
"""Rows a median is taken of at a time."""


def import_opencv() -> Any:
    """The library; InputError where it is not there."""
    try:
        import cv2
    except ImportError:
        raise InputError("OpenCV", None, "the extra: pip install 'optodrive[camera]'", "missing_extra") from None
    return cv2


def read_image(path: Path) -> Image:
    """[rows, columns], 8 or 16 bits; of a picture in colour the blue part, in which the beam and its saturation are."""
    cv2 = import_opencv()
    try:
        raw = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable picture") from None
    # Turned by no mark in the file: marks_px are counted in the picture as the camera took it.
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
        """Read one; InputError where it has another size than the first, or other bits."""
        image = read_image(path)
        if image.shape != (self.rows, self.columns):
            size = f"{image.shape[1]} × {image.shape[0]} pixels"
            raise InputError(str(path), size, f"{self.columns} × {self.rows}, as {self._first.name}")
        if image.dtype != self._depth:
            raise InputError(str(path), str(image.dtype), f"{self._depth}, as {self._first.name}")
        return image

    def read_background(self, pictures: PictureFolder) -> Image:
        """The plane without the beam: the dark picture, or else the median of pictures of spots."""
        if pictures.dark is not None:
            return self(pictures.dark)
        if len(pictures.spot_pictures) < MEDIAN_PICTURES_MIN:
            found = f"{len(pictures.spot_pictures)} spots"
            raise InputError(f"{pictures.path}: dark", None, f"a picture without the beam, beside only {found}")
        chosen = np.unique(np.linspace(0, len(pictures.spot_pictures) - 1, MEDIAN_PICTURES_MAX).astype(int))
        stack = np.stack([self(pictures.spot_pictures[at].path) for at in chosen])
        background: Image = np.empty_like(stack[0])
        for first in range(0, self.rows, MEDIAN_BLOCK_ROWS):
            background[first : first + MEDIAN_BLOCK_ROWS] = np.median(
                stack[:, first : first + MEDIAN_BLOCK_ROWS].astype(np.float32), axis=0
            )
        return background
