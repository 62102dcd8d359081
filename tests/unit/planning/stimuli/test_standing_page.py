"""Which pixels of a standing page are drawn next, and what fingers get."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from optodrive.core.types.stimuli import TactileFrame
from optodrive.device.config import build_pixel_layout
from optodrive.device.config_file import load_config
from optodrive.planning.scheduler.visiting_path import compute_visiting_order
from optodrive.planning.stimuli import standing_page
from optodrive.planning.stimuli.standing_page import (
    REFRESH_PERIOD_S,
    SLOT_S,
    build_refresh,
    select_bursts,
)

PIXEL_S, SLOTS = 3.2e-3, 10
LAYOUT = build_pixel_layout(load_config("display-1511").display)
COUNT = len(LAYOUT)


def find_tour(target_m):
    return compute_visiting_order(np.flatnonzero(target_m), LAYOUT.row, LAYOUT.column, LAYOUT.x_m, LAYOUT.y_m)


def draw_for(seconds, target_m, find_touched, cut_s=0.023):
    """Draw a page as a stream does whose plans are replaced every cut_s. Return pixel and start of every pulse."""
    tour = find_tour(target_m)
    drawn_s, pulses, begin_s = np.full(len(target_m), -np.inf), [], 0.0
    while begin_s < seconds:
        is_touched = np.array([find_touched(begin_s + slot * SLOT_S) for slot in range(SLOTS)])
        end_s = begin_s + cut_s
        for burst in select_bursts(tour, is_touched, drawn_s, begin_s, PIXEL_S):
            for number, pixel in enumerate(burst.pixels.tolist()):
                start_s = begin_s + burst.begin_s + number * PIXEL_S
                if start_s < end_s:
                    pulses.append((pixel, start_s))
                    drawn_s[pixel] = start_s
        begin_s = max(end_s, pulses[-1][1] + PIXEL_S if pulses else 0.0)
    return np.array([pixel for pixel, _ in pulses]), np.array([start_s for _, start_s in pulses])


def starts_of(pixels, starts_s, pixel):
    return starts_s[pixels == pixel]


def touch(*pixels):
    touched = np.zeros(COUNT, dtype=bool)
    touched[list(pixels)] = True
    return lambda at_s: touched


@example(fingers={0, 1, 2, 3, 4, 7}, cut_s=0.015625)
@given(fingers=st.sets(st.integers(0, 199), min_size=1, max_size=12), cut_s=st.floats(0.012, 0.06))
def test_pixels_under_fingers_get_twenty_pulses_per_second_and_no_more_than_they_need(fingers, cut_s):
    target_m = np.zeros(COUNT)
    target_m[:200] = 50e-6
    pixels, starts_s = draw_for(1.0, target_m, touch(*fingers), cut_s)
    for pixel in fingers:
        own_s = starts_of(pixels, starts_s, pixel)
        assert own_s[0] < 0.05
        assert np.diff(own_s).max() <= 0.0555  # its turn, the burst that is being drawn, and the one before it
        assert np.diff(own_s).min() >= REFRESH_PERIOD_S - standing_page.BURST_S - 1e-9


def test_fingers_on_more_than_the_beam_can_refresh_share_it():
    target_m = np.full(COUNT, 50e-6)
    fingers = range(40)
    pixels, _ = draw_for(2.0, target_m, touch(*fingers))
    counts = np.bincount(pixels, minlength=COUNT)
    assert counts[:40].max() - counts[:40].min() <= 2
    assert counts[40:].sum() == 0


def count_under_two_fingers():
    """Return the pulses under either of two fingers on a page that is raised everywhere, in 4 s."""
    hands = [np.argsort(np.hypot(LAYOUT.x_m - x_m, LAYOUT.y_m))[:13] for x_m in (-0.009, 0.009)]
    pixels, _ = draw_for(4.0, np.full(COUNT, 50e-6), touch(*np.concatenate(hands)), 0.05)
    counts = np.bincount(pixels, minlength=COUNT)
    return sorted(int(counts[hand].sum()) for hand in hands)


def test_neither_of_two_fingers_stays_without_light(monkeypatch):
    fewer, more = count_under_two_fingers()
    assert fewer >= 0.9 * more
    take_stretch = standing_page._take_stretch

    def take_from_the_begin(due_s, until_s, first, count):
        return take_stretch(due_s, until_s, 0, count)

    monkeypatch.setattr(standing_page, "_take_stretch", take_from_the_begin)  # mutant
    fewer, more = count_under_two_fingers()
    assert fewer < 0.6 * more


def test_a_page_is_drawn_along_its_tour():
    target_m = np.zeros(COUNT)
    target_m[::4] = 50e-6
    pixels, _ = draw_for(8.0, target_m, touch())
    steps_m = np.hypot(np.diff(LAYOUT.x_m[pixels]), np.diff(LAYOUT.y_m[pixels]))
    tour = find_tour(target_m)
    assert steps_m.mean() <= 1.2 * np.hypot(np.diff(LAYOUT.x_m[tour]), np.diff(LAYOUT.y_m[tour])).mean()


def test_without_fingers_every_pixel_gets_its_turn():
    target_m = np.zeros(COUNT)
    target_m[::5] = 50e-6
    pixels, _ = draw_for(5.0, target_m, touch())
    counts = np.bincount(pixels, minlength=COUNT)
    assert (counts[target_m == 0.0] == 0).all()
    page = counts[target_m > 0.0]
    assert page.min() >= 4
    assert page.max() - page.min() <= 1


def test_beside_two_fingers_the_rest_of_the_page_gets_its_turn():
    target_m = np.zeros(COUNT)
    target_m[:100] = 50e-6
    pixels, _ = draw_for(4.0, target_m, touch(10, 11, 12, 13))
    counts = np.bincount(pixels, minlength=COUNT)
    assert counts[14:100].min() >= 4


def test_only_touched_dots_are_drawn_where_the_rest_is_to_be_dark():
    tour, slots = np.arange(20), 10
    is_touched = np.zeros((slots, COUNT), dtype=bool)
    is_touched[:4, [3, 4]] = is_touched[6:, [9]] = True
    drawn_s = np.full(COUNT, -np.inf)
    bursts = select_bursts(tour, is_touched, drawn_s, 0.0, PIXEL_S, touched_only=True)
    drawn = [(burst.begin_s, pixel) for burst in bursts for pixel in burst.pixels.tolist()]
    assert {pixel for begin_s, pixel in drawn if begin_s < 4 * SLOT_S} == {3, 4}
    assert {pixel for begin_s, pixel in drawn if begin_s >= 4 * SLOT_S} == {9}
    assert min(begin_s for begin_s, pixel in drawn if pixel == 9) == pytest.approx(6 * SLOT_S)
    assert not select_bursts(tour, np.zeros_like(is_touched), drawn_s, 0.0, PIXEL_S, touched_only=True)


def test_the_last_two_dots_beside_the_fingers_get_their_turn():
    target_m = np.zeros(COUNT)
    target_m[:7] = 50e-6
    pixels, _ = draw_for(2.0, target_m, touch(*range(5)))
    assert np.bincount(pixels, minlength=COUNT)[:7].min() >= 30


def test_a_page_of_few_dots_is_drawn_at_its_rate_and_not_more_often():
    target_m = np.zeros(COUNT)
    target_m[[3, 4]] = 50e-6
    pixels, starts_s = draw_for(2.0, target_m, touch())
    for pixel in (3, 4):
        assert 2.0 / REFRESH_PERIOD_S * 0.8 <= len(starts_of(pixels, starts_s, pixel)) <= 2.0 / REFRESH_PERIOD_S + 1


def test_a_dot_that_comes_under_a_finger_is_next():
    target_m = np.zeros(COUNT)
    target_m[:200] = 50e-6
    pixels, starts_s = draw_for(1.0, target_m, lambda at_s: touch(150)(at_s) if at_s >= 0.5 else touch()(at_s))
    after_s = starts_of(pixels, starts_s, 150)
    assert after_s[after_s >= 0.5 - SLOTS * SLOT_S][0] <= 0.5 + PIXEL_S + SLOT_S


def test_the_frames_of_a_refresh_hold_the_page_and_the_order_of_its_bursts():
    target_m = np.linspace(1e-5, 5e-5, COUNT)
    page = TactileFrame("page", 0.0, 1.0, target_m)
    bursts = select_bursts(
        find_tour(target_m), np.zeros((SLOTS, COUNT), dtype=bool), np.full(COUNT, -np.inf), 7.0, PIXEL_S
    )
    sequence, orders = build_refresh(page, bursts, PIXEL_S)
    drawn = np.concatenate([orders[k] for k in range(len(sequence.frames))])
    assert sorted(drawn.tolist()) == sorted(np.concatenate([burst.pixels for burst in bursts]).tolist())
    for k, frame in enumerate(sequence.frames):
        assert np.flatnonzero(frame.target_m).tolist() == sorted(orders[k].tolist())
        assert frame.target_m[orders[k]] == pytest.approx(target_m[orders[k]])


def test_a_page_that_is_not_due_is_a_frame_without_pixels():
    target_m = np.zeros(COUNT)
    page = TactileFrame("page", 0.0, 1.0, target_m)
    bursts = select_bursts(
        find_tour(target_m), np.zeros((SLOTS, COUNT), dtype=bool), np.full(COUNT, -np.inf), 0.0, PIXEL_S
    )
    sequence, _ = build_refresh(page, bursts, PIXEL_S)
    assert [frame.target_m.any() for frame in sequence.frames] == [False]


@given(count=st.integers(1, 12), fingers=st.integers(0, 12), pixel_s=st.floats(1e-3, 2e-2))
def test_no_frame_of_a_refresh_draws_a_pixel_twice(count, fingers, pixel_s):
    """The width of a frame's pulses follows from the heat before the frame."""
    target_m = np.zeros(COUNT)
    target_m[:count] = 50e-6
    is_touched = np.tile(touch(*range(fingers))(0.0), (SLOTS, 1))
    bursts = select_bursts(find_tour(target_m), is_touched, np.full(COUNT, -np.inf), 0.0, pixel_s)
    sequence, orders = build_refresh(TactileFrame("page", 0.0, 1.0, target_m), bursts, pixel_s)
    for k, _ in enumerate(sequence.frames):
        assert len(set(orders[k].tolist())) == len(orders[k])
    assert sum(map(len, orders.values())) == sum(len(burst.pixels) for burst in bursts)
