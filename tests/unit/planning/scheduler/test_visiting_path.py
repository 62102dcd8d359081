"""The visiting order: every pixel once, never longer than row by row, and close to the shortest path."""

from itertools import pairwise, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from displays import DISPLAYS
from optodrive.planning.scheduler import visiting_path
from optodrive.planning.scheduler.visiting_path import (
    compile_kernels,
    compute_serpentine_order,
    compute_visiting_order,
    path_rad,
)

DISPLAY = DISPLAYS["display-437"]
LAYOUT, FIELD = DISPLAY.layout, DISPLAY.scan_head.field
X_RAD, Y_RAD = FIELD.angles_rad(LAYOUT.x_m, LAYOUT.y_m)
PITCH_RAD = float(np.diff(np.unique(X_RAD)).min())
COUNT = len(LAYOUT)


def compute_order(active, origin=None):
    return compute_visiting_order(np.array(sorted(active)), LAYOUT.row, LAYOUT.column, X_RAD, Y_RAD, origin)


def path_length(tour, origin=None):
    """Compute the length of a path in pitches, in plain Python."""
    whole = ([] if origin is None else [origin]) + list(tour)
    moves = (max(abs(X_RAD[a] - X_RAD[b]), abs(Y_RAD[a] - Y_RAD[b])) for a, b in pairwise(whole))
    return sum(moves) / PITCH_RAD


def shortest_path_length(active, origin=None):
    """Compute the length of the shortest of all orders of some pixels, in pitches."""
    tours = np.array(list(permutations(active)))
    if origin is not None:
        tours = np.hstack([np.full((len(tours), 1), origin), tours])
    moves = np.maximum(np.abs(np.diff(X_RAD[tours])), np.abs(np.diff(Y_RAD[tours])))
    return moves.sum(axis=1).min() / PITCH_RAD


@given(
    active=st.sets(st.integers(0, COUNT - 1), min_size=1, max_size=80),
    origin=st.none() | st.integers(0, COUNT - 1),
)
def test_every_pixel_once_and_never_longer_than_row_by_row(active, origin):
    tour = compute_order(active, origin)
    assert sorted(tour.tolist()) == sorted(active)
    rows = compute_serpentine_order(np.array(sorted(active)), LAYOUT.row, LAYOUT.column)
    # Paths of two pixels are not improved.
    if len(active) > 2:
        assert path_length(tour, origin) <= path_length(rows, origin) + 1e-9
    begin = -1 if origin is None else origin
    assert path_rad(tour, X_RAD, Y_RAD, begin) / PITCH_RAD == pytest.approx(path_length(tour, origin))


@settings(max_examples=60)
@given(
    active=st.sets(st.integers(0, COUNT - 1), min_size=3, max_size=7),
    origin=st.none() | st.integers(0, COUNT - 1),
)
def test_small_sets_against_every_order(active, origin):
    shortest = shortest_path_length(active, origin)
    assert path_length(compute_order(active, origin), origin) <= 1.35 * shortest + 1e-9


def test_small_sets_are_close_to_the_shortest_on_average():
    generator = np.random.default_rng(4)
    ours = best = 0.0
    for _ in range(60):
        active = generator.choice(COUNT, 7, replace=False).tolist()
        ours += path_length(compute_order(active))
        best += shortest_path_length(active)
    assert ours <= 1.03 * best


def test_full_lattices_diagonals_and_columns_are_single_steps():
    every = range(COUNT)
    diagonal = [pixel for pixel in every if LAYOUT.row[pixel] == LAYOUT.column[pixel]]
    column = [pixel for pixel in every if LAYOUT.column[pixel] == 3]
    for active in (every, diagonal, column):
        assert path_length(compute_order(active)) <= 1.02 * (len(active) - 1)


def test_clusters_are_left_once():
    """Two distant clusters need one long move between them."""
    here = [p for p in range(COUNT) if LAYOUT.row[p] < 4 and 2 <= LAYOUT.column[p] < 6]
    there = [p for p in range(COUNT) if LAYOUT.row[p] >= 16 and 14 <= LAYOUT.column[p] < 18]
    tour = compute_order([*here, *there])
    jumps = [a for a, b in pairwise(tour.tolist()) if (a in here) != (b in here)]
    assert len(jumps) == 1


def test_the_path_starts_where_the_mirrors_stand():
    active = [0, 10, 18, 200, 210, 420, 436]
    for origin in (0, 436):
        assert compute_order(active, origin)[0] == origin


def test_compile_kernels_leaves_nothing_to_compile():
    """A planner that compiles reports no progress, so the lease could expire."""
    compile_kernels()
    compiled = (
        visiting_path.path_rad,
        visiting_path._find_neighbours,
        visiting_path._improve,
    )  # the kernels that Python calls
    before = [len(kernel.signatures) for kernel in compiled]
    assert min(before) > 0
    compute_order(np.random.default_rng(1).choice(COUNT, 60, replace=False).tolist(), 7)
    assert [len(kernel.signatures) for kernel in compiled] == before
