"""Fingertips from a camera, or from a video of one, that sees the marks of a display.

In successive pictures the nearest fingertip of before keeps its number.
"""

import os
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from optodrive.core.errors import InputError, LinkError, Unquoted
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.fingers import FingerPlace, FingerReport
from optodrive.tracking.fingertips import FingertipDetector, MarksFile, find_view, import_opencv

JUMP_MAX_M = 0.02
"""Largest way between two pictures. One that is farther from all others is a new fingertip."""
MISSED_MAX_S = 0.1
"""Time for which the number of a fingertip that is not found is kept."""


class FingerNumbers:
    """Numbers fingertips. Times are of one clock, and do not decrease."""

    def __init__(self) -> None:
        self._last: dict[int, tuple[float, FloatArray]] = {}
        self._next = 0

    def assign(self, at_s: float, places_m: FloatArray) -> list[int]:
        """Return the numbers of places [n, 2] at a time. The closest pairs of old and new places are the same."""
        self._last = {number: last for number, last in self._last.items() if at_s - last[0] <= MISSED_MAX_S}
        pairs = sorted(
            (float(np.hypot(*(place_m - last_m))), number, row)
            for number, (_, last_m) in self._last.items()
            for row, place_m in enumerate(places_m)
        )
        numbers: dict[int, int] = {}
        for distance_m, number, row in pairs:
            if distance_m <= JUMP_MAX_M and row not in numbers and number not in numbers.values():
                numbers[row] = number
        for row, place_m in enumerate(places_m):
            if row not in numbers:
                numbers[row], self._next = self._next, self._next + 1
            self._last[numbers[row]] = (at_s, place_m)
        return [numbers[row] for row in range(len(places_m))]


BACKGROUND_PICTURES = 15
"""Pictures at the begin, without hands, in which the marks are found and whose median is the background."""
PAD_RADIUS_M = 0.005
"""Radius of a contact, which a camera does not see."""
STAMP_AGE_MAX_S = 0.5
"""Age up to which a driver's stamp is one of CLOCK_MONOTONIC."""
LIFTED_S = 0.05
"""Time after its last picture at which a video that ends with fingers on the display lifts them."""


class Picture(NamedTuple):
    """A grey picture, [rows, columns], and the time at which it was taken."""

    at_s: float
    grey: Any


class Camera:
    """An opened camera or video.

    source: number of a camera, path of its device, or of a video; is_live: whether it is a camera, whose times are
    those of CLOCK_MONOTONIC; those of a video count from its begin. Raises InputError for a source that is none
    """

    def __init__(self, source: str) -> None:
        cv2 = import_opencv()
        self._path = Path(f"/dev/video{source}" if source.isdecimal() else source)
        self.is_live = self._path.is_char_device()
        if not (self.is_live or self._path.is_file()):
            raise InputError(str(self._path), Unquoted("no such file"), "a camera or a video")
        if not os.access(self._path, os.R_OK):
            expected = "a file that may be read, as members of the group `video` may read cameras"
            raise InputError(str(self._path), Unquoted("no permission"), expected)
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        self._stamp = cv2.CAP_PROP_POS_MSEC
        self._grey = cv2.COLOR_BGR2GRAY
        self._cv2 = cv2
        self._capture = cv2.VideoCapture(str(self._path), cv2.CAP_V4L2 if self.is_live else cv2.CAP_ANY)
        if not self._capture.isOpened():
            raise InputError(str(self._path), Unquoted("no pictures"), "a camera or a video that OpenCV reads")
        if self.is_live:
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: object) -> None:
        self._capture.release()

    @property
    def name(self) -> str:
        """Path of the camera or the video."""
        return str(self._path)

    def read_pictures(self) -> Iterator[Picture]:
        """Yield pictures until the video ends. Raise LinkError if the camera gives no more."""
        while True:
            try:
                is_read, picture = self._capture.read()
            except self._cv2.error:  # of a driver that fails, or a picture that cannot be decoded
                break
            if not is_read:
                break
            stamp_s, now_s = 1e-3 * float(self._capture.get(self._stamp)), time.monotonic()
            if self.is_live and not 0.0 <= now_s - stamp_s <= STAMP_AGE_MAX_S:
                stamp_s = now_s
            yield Picture(stamp_s, picture if picture.ndim == 2 else self._cv2.cvtColor(picture, self._grey))
        if self.is_live:
            raise LinkError(f"{self._path}: the camera is gone")


def follow_fingertips(camera: Camera, marks: MarksFile) -> Iterator[FingerReport]:
    """Yield the fingertips of every picture after the first ones, which show the display without hands.

    Raises InputError for too few pictures, and for pictures without the marks.
    """
    pictures = camera.read_pictures()
    first = [picture.grey for picture in islice(pictures, BACKGROUND_PICTURES)]
    if len(first) < BACKGROUND_PICTURES:
        expected = f"at least {BACKGROUND_PICTURES} of the display without hands at its begin"
        raise InputError(camera.name, Unquoted(f"{len(first)} pictures"), expected)
    view = find_view(np.median(first, axis=0).astype(np.uint8), marks, camera.name)
    detector, numbers, at_s = FingertipDetector(view, first), FingerNumbers(), 0.0
    for at_s, grey in pictures:
        places_m = detector.find(grey)
        numbered = zip(numbers.assign(at_s, places_m), places_m.tolist(), strict=True)
        yield FingerReport(at_s, tuple(FingerPlace(number, x_m, y_m, PAD_RADIUS_M) for number, (x_m, y_m) in numbered))
    yield FingerReport(at_s + LIFTED_S, ())
