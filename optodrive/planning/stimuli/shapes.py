"""Static and moving shapes as frames, and a short sequence that demonstrates the display.

A picture holds the heights of all pixels, [p], m.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from optodrive.core.errors import InputError
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.stimuli import FrameSequence, HeightTrain
from optodrive.device.config import Config
from optodrive.planning.stimuli.experiments import build_two_fingers
from optodrive.planning.stimuli.pixel_lattice import Lattice
from optodrive.planning.stimuli.refresh import BeamTimeEstimator, build_steps, hold_picture, sequence_end_s
from optodrive.planning.stimuli.text import build_text

RING_RADIUS_FRACTION = 0.6
"""Default radius of rings and half side of squares, as a fraction of the distance from the middle to the border."""


def build_single_pixel(config: Config, where: str, pixel: int | None, height_m: float, seconds: float) -> FrameSequence:
    """Build one pixel (None: the middle), drawn again and again."""
    lattice = Lattice.from_config(config)
    chosen_pixel = lattice.middle_pixel() if pixel is None else pixel
    return _hold_mask(
        config, np.arange(len(lattice.layout)) == chosen_pixel, height_m, seconds, f"pixel-{chosen_pixel}"
    )


def build_vibration(
    config: Config,
    where: str,
    pixel: int | None,
    height_m: float,
    peak_to_peak_m: float | None,
    rate_hz: float,
    seconds: float,
) -> FrameSequence:
    """Build a height train on one pixel.

    pixel: None for the middle; peak_to_peak_m: None for that of the shortest pulses
    """
    chosen_pixel = Lattice.from_config(config).middle_pixel() if pixel is None else pixel
    return FrameSequence(trains=(HeightTrain(chosen_pixel, 0.0, seconds, 1.0 / rate_hz, height_m, peak_to_peak_m),))


def build_all_pixels(config: Config, where: str, height_m: float, seconds: float) -> FrameSequence:
    """Build every pixel at one height."""
    return _hold_mask(
        config, np.ones(len(Lattice.from_config(config).layout), dtype=np.bool_), height_m, seconds, "all"
    )


def build_checkerboard(config: Config, where: str, height_m: float, seconds: float) -> FrameSequence:
    """Build every other pixel, as on a chessboard."""
    layout = Lattice.from_config(config).layout
    return _hold_mask(config, (layout.row + layout.column) % 2 == 0, height_m, seconds, "checker")


def build_ring(config: Config, where: str, radius_m: float | None, height_m: float, seconds: float) -> FrameSequence:
    """Build a ring about the display's middle, one pixel wide. Raise InputError (does_not_fit)."""
    ring = np.isin(np.arange(len(Lattice.from_config(config).layout)), find_ring_pixels(config, where, radius_m))
    return _hold_mask(config, ring, height_m, seconds, "circle")


def build_square_outline(
    config: Config, where: str, side_m: float | None, height_m: float, seconds: float
) -> FrameSequence:
    """Build the outline of a square about the display's middle, one pixel wide. Raise InputError (does_not_fit)."""
    layout = Lattice.from_config(config).layout
    half_m = _default_radius_m(config) if side_m is None else side_m / 2
    farthest_m = np.maximum(np.abs(layout.x_m), np.abs(layout.y_m))
    outline = _is_within_half_pitch(farthest_m, half_m, config.display.pitch_m)
    if not outline.any():
        raise _too_large_error(config, f"{where}: side_mm", 2e3 * half_m)
    return _hold_mask(config, outline, height_m, seconds, "square")


def build_moving_edge(config: Config, where: str, direction: str, height_m: float, step_s: float) -> FrameSequence:
    """Build a line of pixels that moves across the display, one pitch per step."""
    layout = Lattice.from_config(config).layout
    line = layout.column if direction in ("left", "right") else layout.row
    places = np.arange(line.max() + 1)[:: -1 if direction in ("left", "down") else 1]
    pictures = [np.where(line == place, height_m, 0.0) for place in places]
    return FrameSequence(frames=tuple(build_steps(BeamTimeEstimator(config), pictures, step_s, "edge")))


def build_moving_dot(
    config: Config, where: str, radius_m: float | None, height_m: float, step_s: float, turns: int
) -> FrameSequence:
    """Build one pixel at a time along a ring, clockwise from the left. Raise InputError (does_not_fit)."""
    layout = Lattice.from_config(config).layout
    ring = find_ring_pixels(config, where, radius_m)
    ring = ring[np.argsort(-np.arctan2(layout.y_m[ring], layout.x_m[ring]), kind="stable")]
    pictures = [np.where(np.arange(len(layout)) == pixel, height_m, 0.0) for pixel in ring] * turns
    return FrameSequence(frames=tuple(build_steps(BeamTimeEstimator(config), pictures, step_s, "dot")))


def find_ring_pixels(config: Config, where: str, radius_m: float | None) -> NDArray[np.int64]:
    """Return the pixels of a ring about the middle by index (None: default radius). Raise InputError (does_not_fit)."""
    layout = Lattice.from_config(config).layout
    radius_m = _default_radius_m(config) if radius_m is None else radius_m
    ring = np.flatnonzero(_is_within_half_pitch(np.hypot(layout.x_m, layout.y_m), radius_m, config.display.pitch_m))
    if not len(ring):
        raise _too_large_error(config, f"{where}: radius_mm", 1e3 * radius_m)
    return ring


def _hold_mask(config: Config, mask: NDArray[np.bool_], height_m: float, seconds: float, name: str) -> FrameSequence:
    return FrameSequence(
        frames=tuple(hold_picture(BeamTimeEstimator(config), np.where(mask, height_m, 0.0), seconds, name))
    )


def _default_radius_m(config: Config) -> float:
    places = min(config.display.rows, config.display.columns)
    return RING_RADIUS_FRACTION * config.display.pitch_m * (places - 1) / 2


def _is_within_half_pitch(distance_m: FloatArray, target_distance_m: float, pitch_m: float) -> NDArray[np.bool_]:
    offset = np.round((distance_m - target_distance_m) / pitch_m, 6)
    return np.asarray((offset > -0.5) & (offset <= 0.5))


def _too_large_error(config: Config, where: str, value_mm: float) -> InputError:
    display = config.display
    width_mm, height_mm = (1e3 * display.pitch_m * (places - 1) for places in (display.columns, display.rows))
    expected = f"a size that meets pixels of {config.name}, {width_mm:g} × {height_mm:g} mm from centre to centre"
    return InputError(where, round(value_mm, 3), expected, code="does_not_fit")


PAUSE_S = 0.3
"""Pause between two parts, s."""


def build_showcase(config: Config, where: str) -> FrameSequence:
    """Build a dot along a ring, the ring, "hello" in braille, and two pairs of fingers, in about eight seconds.

    Raises InputError (does_not_fit) on a display too small for a hand.
    """
    return concatenate_sequences(
        build_moving_dot(config, where, radius_m=None, height_m=200e-6, step_s=0.06, turns=1),
        build_ring(config, where, radius_m=None, height_m=100e-6, seconds=1.5),
        build_text(config, where, "hello", height_m=150e-6, seconds=2.0),
        build_two_fingers(config, where, "2-4", centre=None),
        build_two_fingers(config, where, "3-5", centre=None),
    )


def concatenate_sequences(*sequences: FrameSequence) -> FrameSequence:
    """Concatenate sequences in time, with a pause between them."""
    concatenated, start_s = FrameSequence(), 0.0
    for sequence in sequences:
        concatenated = FrameSequence(
            frames=concatenated.frames + tuple(replace(f, show_at_s=f.show_at_s + start_s) for f in sequence.frames),
            trains=concatenated.trains + tuple(replace(t, start_s=t.start_s + start_s) for t in sequence.trains),
        )
        start_s = sequence_end_s(concatenated) + PAUSE_S
    return concatenated
