"""Frames from images and animations, with brightness averaged over each lattice place as height."""

import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from optodrive.core.errors import InputError, build_nothing_raised_error
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import FrameSequence, TactileFrame
from optodrive.device.config import Config
from optodrive.planning.stimuli.pixel_lattice import Lattice
from optodrive.planning.stimuli.refresh import BeamTimeEstimator, hold_picture

if TYPE_CHECKING:
    from PIL.Image import Image

FORMATS = ("PNG", "JPEG", "GIF")
SOURCE_PIXELS_MAX = 16_000_000
"""Largest number of pixels of an image file."""
SIDE_MAX = 20_000
"""Largest width and height of an image: the weights of a lattice place cover a whole side."""
ANIMATION_PIXELS_MAX = 64_000_000
"""Largest number of pixels of all images of an animation: about three seconds of computation."""
SCANS_MAX = 100
"""Largest number of passes of a JPEG over its picture, each of which takes the work of the whole."""
SCAN_MARK = b"\xff\xda"

ANIMATION_FRAMES_MAX = 2_000
FRAME_DURATION_MIN_S, FRAME_DURATION_MAX_S = 0.02, 60.0
FRAME_DURATION_DEFAULT_S = 0.1
"""Duration of an image for which the file states none, s."""

BRIGHTNESS_MIN = 0.04
"""Smallest brightness that is driven: a lower one could not be felt, and each pulse costs beam time."""


def build_image(
    config: Config, where: str, file: bytes, height_m: float, seconds: float, invert: bool
) -> FrameSequence:
    """Build frames that show an image (the first of several) for `seconds`, white at height_m.

    Raises InputError (bad_picture, too_many, raises_nothing).
    """
    lattice = Lattice.from_config(config)
    with _open_image(file, f"{where}: file") as image:
        brightness = compute_lattice_brightness(image, lattice, invert)
    _check_raised([brightness], invert, f"{where}: file")
    target_m = height_m * brightness.driven
    return FrameSequence(frames=tuple(hold_picture(BeamTimeEstimator(config), target_m, seconds, "image")))


def build_animation(
    config: Config, where: str, file: bytes, height_m: float, rate_hz: float | None, invert: bool
) -> FrameSequence:
    """Build frames that show the images of an animated GIF or PNG once each.

    An image lasts 1 / rate_hz. If rate_hz is None it lasts as long as the file states, at least 20 ms and its beam
    time. Raises InputError (bad_picture, too_many, raises_nothing).
    """
    beam, start_s, pixels = BeamTimeEstimator(config), 0.0, 0
    frames: list[TactileFrame] = []
    pictures: list[LatticeBrightness] = []
    with _open_image(file, f"{where}: file") as image:
        for position in _select_positions(image, f"{where}: file"):
            image.seek(position)
            _check_size(image, f"{where}: file")  # a later image of a GIF may be larger than the first
            pixels += image.width * image.height
            if pixels > ANIMATION_PIXELS_MAX:
                raise _too_many_pixels_error(f"{where}: file", f"{len(frames) + 1} pictures of {pixels} pixels")
            pictures.append(compute_lattice_brightness(image, beam.lattice, invert))
            target_m = height_m * pictures[-1].driven
            duration_s = 1.0 / rate_hz if rate_hz else max(_duration_s(image), beam.beam_time_s(target_m))
            frames.append(TactileFrame(f"animation-{len(frames)}", start_s, duration_s, target_m))
            start_s += duration_s
    _check_raised(pictures, invert, f"{where}: file")
    return FrameSequence(frames=tuple(frames))


class LatticeBrightness(NamedTuple):
    """Brightness of a picture on the lattice, all 0…1.

    driven: [p] of each pixel, 0 below BRIGHTNESS_MIN; brightest: of all samples, all places and all pixels
    opacity: of the most opaque sample
    """

    driven: FloatArray
    brightest: tuple[float, float, float]
    opacity: float


def _check_raised(pictures: list[LatticeBrightness], invert: bool, where: str) -> None:
    """Raise InputError (raises_nothing) for pictures that raise no pixel, with the reason."""
    if any(each.driven.any() for each in pictures):
        return
    sample, place, pixel = np.max([each.brightest for each in pictures], axis=0).tolist()
    raised, left = ("dark", "white") if invert else ("bright", "black")
    other = "" if invert else ", or invert=true, which raises dark ones"
    expected = f"a picture with {raised} areas on the display's pixels{other}"
    if not any(each.opacity for each in pictures):
        reason, expected = "it is wholly transparent", "an opaque pixel"
    elif sample == 0.0:
        reason = f"it is {left} everywhere"
    elif place >= BRIGHTNESS_MIN:
        reason = f"its {raised} areas lie where the display has no pixel"
    else:
        reason = (
            f"no pixel's area reaches {100 * BRIGHTNESS_MIN:g} % of full height, the highest is {100 * pixel:.2g} %"
        )
    raise build_nothing_raised_error(where, reason, expected)


def compute_lattice_brightness(image: "Image", lattice: Lattice, invert: bool) -> LatticeBrightness:
    """Compute the brightness of each pixel from the whole image, fitted into the lattice and centred."""
    brightness, opacity = _compute_brightness(image, invert)
    rows, columns = lattice.index.shape
    height, width = brightness.shape
    scale = max(height / rows, width / columns)
    down, across = _compute_overlap(rows, height, scale), _compute_overlap(columns, width, scale)
    fitted = (down @ brightness @ across.T)[::-1]
    values = np.asarray(fitted[lattice.layout.row, lattice.layout.column], dtype=np.float64)
    brightest = float(brightness.max()), float(fitted.max()), float(values.max())
    return LatticeBrightness(np.where(values < BRIGHTNESS_MIN, 0.0, np.minimum(values, 1.0)), brightest, opacity)


def _compute_overlap(place_count: int, pixel_count: int, scale: float) -> NDArray[np.float32]:
    """Compute the fraction of each place covered by each source pixel, [places, pixels].

    scale: source pixels per place.
    """
    low = pixel_count / 2 + (np.arange(place_count)[:, None] - place_count / 2) * scale
    pixel = np.arange(pixel_count)[None, :]
    covered = np.clip(np.minimum(low + scale, pixel + 1) - np.maximum(low, pixel), 0.0, None)
    return np.asarray(covered / scale, dtype=np.float32)


def _compute_brightness(image: "Image", invert: bool) -> tuple[NDArray[np.float32], float]:
    """Compute brightness 0…1, [rows from the top, columns], and the highest opacity.

    Transparency is dark, inverted or not.
    """
    from PIL import ImageOps

    image = ImageOps.exif_transpose(image)
    if image.mode.startswith("I"):
        grey = np.clip(np.asarray(image, dtype=np.float32) / np.float32(65535.0), 0.0, 1.0)
        return np.asarray(1.0 - grey if invert else grey, dtype=np.float32), 1.0
    rgba = image.convert("RGBA")
    grey = np.asarray(rgba.convert("RGB").convert("L"), dtype=np.float32) / 255.0
    alpha = np.asarray(rgba.getchannel("A"), dtype=np.float32) / 255.0
    return np.asarray((1.0 - grey if invert else grey) * alpha, dtype=np.float32), float(alpha.max())


def _duration_s(image: "Image") -> float:
    """Return the duration that the file states for this image, s.

    A PNG may carry a text chunk of the same name, which is ignored.
    """
    duration_ms = image.info.get("duration")
    if not isinstance(duration_ms, int | float) or not 0 < duration_ms < float("inf"):
        return FRAME_DURATION_DEFAULT_S
    return min(max(duration_ms / 1e3, FRAME_DURATION_MIN_S), FRAME_DURATION_MAX_S)


def _select_positions(image: "Image", where: str) -> range:
    """Return the images of the file that belong to the animation. Raise InputError (too_many)."""
    count = int(getattr(image, "n_frames", 1))
    if count > ANIMATION_FRAMES_MAX:
        raise InputError(where, f"{count} pictures", f"at most {ANIMATION_FRAMES_MAX}", code="too_many")
    if count * image.width * image.height > ANIMATION_PIXELS_MAX:
        size = f"{count} pictures of {image.width} × {image.height}"
        raise _too_many_pixels_error(where, size)
    first = 1 if image.info.get("default_image") and count > 1 else 0
    return range(first, count)


@contextmanager
def _open_image(file: bytes, where: str) -> Iterator["Image"]:
    """Open an image of a supported format and size. Every error while reading becomes an InputError."""
    from PIL import Image, UnidentifiedImageError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        try:
            with Image.open(BytesIO(file), formats=FORMATS) as image:
                _check_size(image, where)
                if image.format == "JPEG" and file.count(SCAN_MARK) > SCANS_MAX:
                    found = f"a JPEG of {file.count(SCAN_MARK)} passes"
                    raise InputError(where, found, f"at most {SCANS_MAX}", code="too_many")
                yield image
        except (Image.DecompressionBombError, Image.DecompressionBombWarning):
            raise _too_large_error(where, "a far larger picture") from None
        except UnidentifiedImageError:
            raise InputError(where, file[:16], "a picture: " + ", ".join(FORMATS), code="bad_picture") from None
        except (OSError, SyntaxError, ValueError, EOFError, IndexError, KeyError, struct.error, zlib.error) as error:
            raise InputError(where, str(error), "a picture without damage", code="bad_picture") from None


def _check_size(image: "Image", where: str) -> None:
    """Raise InputError (too_many) for an image with too many pixels or too long a side."""
    if image.width * image.height > SOURCE_PIXELS_MAX or max(image.size) > SIDE_MAX:
        raise _too_large_error(where, f"{image.width} × {image.height}")


def _too_many_pixels_error(where: str, found: str) -> InputError:
    return InputError(where, found, f"at most {ANIMATION_PIXELS_MAX} pixels in all", code="too_many")


def _too_large_error(where: str, size: str) -> InputError:
    return InputError(
        where, size, f"a picture of at most {SOURCE_PIXELS_MAX} pixels, {SIDE_MAX} a side", code="too_many"
    )
