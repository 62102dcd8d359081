"""Independent judge of the light that fingers get, from the board's log and the true places of the fingers.

Of the dots under a pad at a time those count that had a pulse to at least SHARE_MIN of their height within the last
WINDOW_S; the thermal model gives the height.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

WINDOW_S, SHARE_MIN = 0.05, 0.9
DUTY_MAX = 65535


class Touch(NamedTuple):
    """A fingertip that touches the display at a time."""

    number: int
    x_m: float
    y_m: float


class Pulses(NamedTuple):
    """Pulses of a board's log, [n].

    pixel; start_s: in the host's time; peak_m: displacement to which the thermal model raises the pixel; energy_j
    """

    pixel: np.ndarray
    start_s: np.ndarray
    peak_m: np.ndarray
    energy_j: np.ndarray


def read_pulses(board, display):
    """Return the pulses of a simulated board's log."""
    return build_pulses(board.all_of("pulse"), read_zero_s(board), display)


def build_pulses(events, zero_s, display):
    """Return the pulses of a log's events, with its zero in the host's time."""
    from optodrive.link.board_setup import build_board_requirements

    layout, angle = display.layout, 1.0 / (2.0 * display.config.scanner.focal_length_m)
    scale = build_board_requirements(display.config).scale
    codes = np.column_stack([scale.to_codes(layout.x_m * angle), scale.to_codes(layout.y_m * angle)])
    pixel_of = {tuple(code): pixel for pixel, code in enumerate(codes.tolist())}
    pixel = np.array([pixel_of[event["x"], event["y"]] for event in events])
    on_s, off_s = (1e-6 * np.array([event[key] for event in events]) for key in ("on_us", "off_us"))
    power_w = scale.full_power_w / DUTY_MAX * np.array([event["duty"] for event in events])
    peaks = display.build_cold_heat().apply_pulses(pixel, on_s, off_s - on_s, power_w)
    return Pulses(pixel, zero_s + on_s, peaks.displacement_m, power_w * (off_s - on_s))


def read_zero_s(board):
    """Return the host's time at the zero of the board's log."""
    return float(Path(f"{board.port}.clock").read_text())


def judge(pulses, display, target_m, find_touches, times_s, radius_m):
    """Return of all dots under pads at all times the share with a high enough pulse in time, and their number.

    find_touches: returns the true fingertips at a time of the host, which `times_s` are, too
    """
    layout = display.layout
    raised = np.flatnonzero(target_m)
    is_high = pulses.peak_m >= SHARE_MIN * target_m[pulses.pixel]
    starts = {pixel: pulses.start_s[(pulses.pixel == pixel) & is_high] for pixel in raised.tolist()}
    good = seen = 0
    for at_s in times_s:
        for touch in find_touches(at_s):
            distance_m = np.hypot(layout.x_m[raised] - touch.x_m, layout.y_m[raised] - touch.y_m)
            for pixel in raised[distance_m <= radius_m].tolist():
                row = np.searchsorted(starts[pixel], at_s)
                seen += 1
                good += row > 0 and starts[pixel][row - 1] > at_s - WINDOW_S
    return good / seen, seen


class Light(NamedTuple):
    """What the dots under a finger got: pulses per second and dot, and the mean share of their heights."""

    rate_hz: float
    height_share: float


def measure_light(pulses, display, target_m, place, end_s, window_s, radius_m):
    """Return what the dots under a finger got in the time before an end, dot by dot, None without a dot.

    place: the true place [x, y] of the fingertip at the end; end_s: in the host's time
    """
    layout, counts, shares = display.layout, [], []
    is_recent = (pulses.start_s > end_s - window_s) & (pulses.start_s <= end_s)
    for pixel in np.flatnonzero(target_m).tolist():
        if np.hypot(layout.x_m[pixel] - place[0], layout.y_m[pixel] - place[1]) <= radius_m:
            peaks_m = pulses.peak_m[is_recent & (pulses.pixel == pixel)]
            counts.append(len(peaks_m))
            shares.append(min(1.0, peaks_m[-1] / target_m[pixel]) if len(peaks_m) else 0.0)
    return Light(np.mean(counts) / window_s, np.mean(shares)) if counts else None
