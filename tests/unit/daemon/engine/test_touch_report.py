"""What the dots under fingers get: counted over the last moments, from executed pulses alone."""

import numpy as np
import pytest

from optodrive.core.finger_tracks import PredictedFinger
from optodrive.daemon.engine.telemetry_events import WINDOW_S, TouchReport
from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import load_config

LAYOUT = build_pixel_layout(load_config().display)
PAGE_M = np.zeros(len(LAYOUT))
PAGE_M[[200, 201, 300]] = 50e-6


def put_finger(pixel, radius_m=0.001, number=1):
    return PredictedFinger(number, float(LAYOUT.x_m[pixel]), float(LAYOUT.y_m[pixel]), radius_m, 0.002)


def add_pulses(report, pixel, rate_hz, height_m, begin_s=0.0, end_s=1.0):
    for start_s in np.arange(begin_s, end_s, 1.0 / rate_hz):
        report.add(np.array([pixel]), np.array([start_s]), np.array([height_m]))


def test_rate_and_height_are_those_of_the_dots_under_the_finger():
    report = TouchReport(LAYOUT)
    add_pulses(report, 201, 50.0, 40e-6)
    add_pulses(report, 200, 25.0, 60e-6)
    (alone,) = report.build(1.0, [put_finger(200)], PAGE_M)
    assert (alone.dots, alone.height_share) == (1, 1.0)
    assert alone.rate_hz == pytest.approx(25.0, abs=1.0 / WINDOW_S)
    (both,) = report.build(1.0, [put_finger(200, LAYOUT.x_m[201] - LAYOUT.x_m[200] + 1e-4)], PAGE_M)
    assert (both.dots, both.height_share) == (2, 0.9)
    assert both.rate_hz == pytest.approx(37.5, abs=1.0 / WINDOW_S)


def test_a_dot_without_light_counts_as_nothing_and_a_place_without_dots_as_unknown():
    report = TouchReport(LAYOUT)
    add_pulses(report, 200, 25.0, 60e-6)
    dark, empty = report.build(1.0, [put_finger(300), put_finger(100, number=2)], PAGE_M)
    assert (dark.dots, dark.rate_hz, dark.height_share) == (1, 0.0, 0.0)
    assert (empty.number, empty.dots, empty.rate_hz, empty.height_share) == (2, 0, None, None)


def test_the_window_ends_with_the_newest_report_but_does_not_wait_for_one():
    report = TouchReport(LAYOUT)
    add_pulses(report, 200, 50.0, 50e-6)
    late, gone = (report.build(at_s, [put_finger(200)], PAGE_M)[0] for at_s in (1.1, 1.5))
    assert late.rate_hz == pytest.approx(50.0, abs=1.0 / WINDOW_S)
    assert (gone.rate_hz, gone.height_share) == (0.0, 0.0)


def test_nothing_is_kept_from_before_a_restart_of_the_board_s_clock():
    report = TouchReport(LAYOUT)
    add_pulses(report, 200, 50.0, 50e-6, 100.0, 101.0)
    report.clear()
    add_pulses(report, 200, 10.0, 50e-6)
    assert report.build(1.0, [put_finger(200)], PAGE_M)[0].rate_hz == pytest.approx(10.0, abs=1.0 / WINDOW_S)
