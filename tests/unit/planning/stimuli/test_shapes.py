"""Shapes, beam time estimates, refreshed pictures and the showcase."""

from itertools import pairwise

import numpy as np
import pytest

from optodrive.core.errors import InputError
from optodrive.device.config_file import list_shipped_configs, load_config
from optodrive.physics.parameters import load_parameters
from optodrive.physics.pixel import advance, cooling_peak
from optodrive.planning.stimuli.experiments import build_intensity
from optodrive.planning.stimuli.pixel_lattice import Lattice
from optodrive.planning.stimuli.refresh import (
    BEAM_TIME_MARGIN,
    BeamTimeEstimator,
    build_steps,
    hold_picture,
    sequence_end_s,
)
from optodrive.planning.stimuli.shapes import (
    build_all_pixels,
    build_checkerboard,
    build_moving_dot,
    build_moving_edge,
    build_ring,
    build_showcase,
    build_square_outline,
    concatenate_sequences,
    find_ring_pixels,
)

CONFIG = load_config("display-437")
LAYOUT = Lattice.from_config(CONFIG).layout
PITCH_M = 3.6e-3
PITCH_MOVE_S = 383e-6


def raised(frame):
    return np.flatnonzero(frame.target_m)


def test_lattice_and_layout_are_inverse():
    for name in list_shipped_configs():
        lattice = Lattice.from_config(load_config(name))
        found = [
            lattice.pixel_at(int(r), int(c)) for r, c in zip(lattice.layout.row, lattice.layout.column, strict=True)
        ]
        assert found == list(range(len(lattice.layout)))
    lattice = Lattice.from_config(CONFIG)
    assert lattice.pixel_at(0, 0) is None
    assert lattice.pixel_at(-1, 5) is None
    assert lattice.pixel_at(5, 21) is None


@pytest.mark.parametrize("target_um", [5, 50, 150, 400])
def test_the_shortest_pulse_that_reaches_a_height(target_um):
    pixel = load_parameters(CONFIG.pixel_model.parameters).build_pixel(CONFIG.display.bridge_width_m)
    width_s = BeamTimeEstimator(CONFIG).min_pulse_s(target_um * 1e-6)

    def peak_m(seconds):
        return pixel.kappa_m_per_k * cooling_peak(pixel, *advance(pixel, 0.0, 0.0, 2.45, seconds))[0]

    assert peak_m(width_s - 2e-4) < target_um * 1e-6 <= peak_m(width_s)
    assert width_s / 2e-4 == pytest.approx(round(width_s / 2e-4))


def test_an_unreachable_height_counts_as_the_longest_pulse():
    assert BeamTimeEstimator(CONFIG).min_pulse_s(1.0) == pytest.approx(0.05)


def test_beam_time_is_the_sum_of_pulses_and_settling_times():
    beam, target_m = BeamTimeEstimator(CONFIG), np.zeros(437)
    assert beam.beam_time_s(target_m) == 0.0
    target_m[200] = 50e-6
    alone_s = beam.beam_time_s(target_m)
    assert alone_s == pytest.approx(BEAM_TIME_MARGIN * (beam.min_pulse_s(50e-6) + PITCH_MOVE_S), abs=1e-3)
    target_m[:] = 50e-6
    assert beam.beam_time_s(target_m) == pytest.approx(
        BEAM_TIME_MARGIN * 437 * (beam.min_pulse_s(50e-6) + PITCH_MOVE_S), rel=0.01
    )


def test_a_picture_is_held_by_refreshing_it():
    beam, target_m = BeamTimeEstimator(CONFIG), np.full(437, 50e-6)
    frames = hold_picture(beam, target_m, 4.0, "x", start_s=1.0)
    each_s = beam.beam_time_s(target_m)
    assert [frame.frame_id for frame in frames] == ["x-0", "x-1", "x-2"]
    assert [frame.show_at_s for frame in frames] == pytest.approx([1.0, 1.0 + each_s, 1.0 + 2 * each_s])
    assert frames[-1].show_at_s + each_s >= 5.0
    assert len(hold_picture(beam, target_m, 0.0, "x")) == 1
    assert len(hold_picture(beam, np.zeros(437), 0.5, "x")) == 5


def test_steps_last_as_requested_or_as_the_beam_needs():
    beam, full, none = BeamTimeEstimator(CONFIG), np.full(437, 50e-6), np.zeros(437)
    first, second, third = build_steps(beam, [none, full, none], 0.2, "s")
    assert (first.duration_s, third.duration_s) == (0.2, 0.2)
    assert second.duration_s == beam.beam_time_s(full) > 1.0
    assert third.show_at_s == pytest.approx(0.2 + second.duration_s)


def test_checker_leaves_every_neighbour_down():
    up = build_checkerboard(CONFIG, "t", 50e-6, 0.0).frames[0].target_m > 0
    for one, two in ((LAYOUT.row, LAYOUT.column), (LAYOUT.column, LAYOUT.row)):
        order = np.lexsort((two, one))
        for a, b in pairwise(order):
            if one[a] == one[b] and two[b] - two[a] == 1:
                assert up[a] != up[b]


def test_circle_is_a_closed_ring_of_its_radius():
    ring = raised(build_ring(CONFIG, "t", 20e-3, 1e-4, 0.0).frames[0])
    radius_m = np.hypot(LAYOUT.x_m[ring], LAYOUT.y_m[ring])
    assert np.all(np.abs(radius_m - 20e-3) <= PITCH_M / 2)
    angle = np.sort(np.arctan2(LAYOUT.y_m[ring], LAYOUT.x_m[ring]))
    assert np.diff(angle, append=angle[0] + 2 * np.pi).max() < 1.5 * PITCH_M / 20e-3


def test_square_is_an_outline():
    outline = raised(build_square_outline(CONFIG, "t", 12 * PITCH_M, 1e-4, 0.0).frames[0])
    assert len(outline) == 4 * 12
    assert np.maximum(np.abs(LAYOUT.x_m[outline]), np.abs(LAYOUT.y_m[outline])) == pytest.approx(6 * PITCH_M)


@pytest.mark.parametrize(
    ("direction", "axis", "sign"), [("right", "x_m", 1), ("left", "x_m", -1), ("up", "y_m", 1), ("down", "y_m", -1)]
)
def test_edge_moves_line_by_line(direction, axis, sign):
    frames = build_moving_edge(CONFIG, "t", direction, 50e-6, 0.1).frames
    along = [set(np.round(getattr(LAYOUT, axis)[raised(frame)], 9)) for frame in frames]
    assert [len(line) for line in along] == [1] * 21
    assert np.diff([line.pop() for line in along]) == pytest.approx(sign * PITCH_M)
    assert sum(len(raised(frame)) for frame in frames) == 437


def test_dot_visits_the_ring_clockwise():
    frames = build_moving_dot(CONFIG, "t", None, 2e-4, 0.06, 2).frames
    path = [int(raised(frame)[0]) for frame in frames]
    ring = find_ring_pixels(CONFIG, "t", None)
    assert all(len(raised(frame)) == 1 for frame in frames)
    assert path[: len(ring)] == path[len(ring) :]
    assert set(path) == set(ring)
    angle = np.unwrap(np.arctan2(LAYOUT.y_m[path[: len(ring)]], LAYOUT.x_m[path[: len(ring)]]))
    assert np.all(np.diff(angle) < 0)


@pytest.mark.parametrize("build", [build_ring, build_square_outline])
def test_a_shape_beyond_the_display_is_refused(build):
    with pytest.raises(InputError, match=r"t: (radius|side)_mm: got .* 72 × 72 mm from centre to centre") as caught:
        build(CONFIG, "t", 0.5, 1e-4, 1.0)
    assert caught.value.code == "does_not_fit"


def test_sequences_are_concatenated_with_pauses():
    first, second = build_all_pixels(CONFIG, "t", 50e-6, 0.0), build_intensity(CONFIG, "t", 5, None)
    joined = concatenate_sequences(first, second, first)
    assert joined.trains[0].start_s == pytest.approx(sequence_end_s(first) + 0.3)
    assert joined.frames[1].show_at_s == pytest.approx(sequence_end_s(first) + 0.3 + 0.975 + 0.3)
    assert sequence_end_s(joined) == pytest.approx(2 * sequence_end_s(first) + 0.6 + 0.975)


@pytest.mark.parametrize("name", ["display-357", "display-437", "display-1511"])
def test_the_showcase_is_short_and_complete(name):
    sequence = build_showcase(load_config(name), "showcase")
    assert 7.0 < sequence_end_s(sequence) < 10.5
    assert {frame.frame_id.split("-")[0] for frame in sequence.frames} == {"dot", "circle", "page"}
    assert len(sequence.trains) == 16
    assert all(a.show_at_s + a.duration_s <= b.show_at_s + 1e-9 for a, b in pairwise(sequence.frames))
    assert len({frame.frame_id for frame in sequence.frames}) == len(sequence.frames)
