"""Encoding to points and decoding: emission within the planned pulses, bounded energy loss, early mirror moves."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dac.bench import build_config, build_display, build_frame, build_train, build_verified, raw_points
from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.plans import EMPTY_PLAN
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.device.config import Config
from optodrive.link.dac.encoding import PointScale, decode, encode
from optodrive.link.dac.formats.base import CHUNK_MAX_S
from optodrive.link.dac.formats.helios import HeliosFormat
from optodrive.link.dac.player import verify_chunks
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.limiter.limiter import limit
from optodrive.planning.pipeline import plan_sequence


@pytest.mark.parametrize(("requested", "actual"), [(20_000, 19_996.43), (40_000, 39_985.72), (50_000, 49_977.69)])
def test_the_rate_is_rounded_by_the_dac(requested, actual):
    assert 112e6 / HeliosFormat(requested).point_ticks == pytest.approx(actual, abs=0.01)


def test_which_frames_fill_whole_packets():
    assert [points for points in range(4096) if not HeliosFormat(40_000).accepts_length(points)] == list(
        range(45, 4096, 64)
    )


@st.composite
def sequences(draw):
    count = 16
    frames, at = [], 0.0
    for number in range(draw(st.integers(0, 2))):
        target = np.zeros(count)
        target[draw(st.lists(st.integers(0, count - 1), min_size=1, max_size=6))] = draw(st.floats(1e-6, 40e-6))
        frames.append(TactileFrame(f"f{number}", at, 0.4, target))
        at += draw(st.floats(0.4, 0.9))
    trains = ()
    if draw(st.booleans()):
        width = draw(st.integers(1, 200)) * 2e-4
        trains = (
            PulseTrain(
                draw(st.integers(0, 15)), at, 0.3, width, draw(st.floats(1e-3, 0.2)), draw(st.floats(0.01, 2.4))
            ),
        )
    return FrameSequence(tuple(frames), trains)


def build_cut_at_its_end():
    """Return a train with a pulse whose last lit point is the last one of a frame, which is blank."""
    target = np.zeros(16)
    target[0] = 1.0288831538445006e-05
    train = PulseTrain(0, 0.6590443679293911, 0.3, 0.0218, 1e-3, 1.0)
    return FrameSequence((TactileFrame("f0", 0.0, 0.4, target),), (train,))


@settings(max_examples=60)
@given(sequences(), st.sampled_from([20_000, 33_333, 40_000, 50_000]))
@example(build_cut_at_its_end(), 33_333)
def test_emission_lies_within_the_plan_and_the_energy_loss_is_bounded(sequence, rate):
    display = build_display(points_per_s=rate)
    plan, verified = build_verified(display, sequence)
    scale, pulses, row = PointScale.from_config(display.config), verified.pulses, verified.row
    end_s, plan_end_s = pulses.start_s + pulses.width_s, plan.start_s + plan.width_s
    assert (pulses.start_s >= plan.start_s[row] - 1e-9).all()
    assert (end_s <= plan_end_s[row] + 1e-9).all()
    assert (pulses.power_w <= plan.power_w[row] * (1 + 1e-9)).all()
    assert (np.abs(pulses.x_rad - plan.x_rad[row]) <= 0.5001 * scale.rad_per_code).all()
    assert (np.abs(pulses.y_rad - plan.y_rad[row]) <= 0.5001 * scale.rad_per_code).all()
    blank_s = (np.cumsum([chunk.points for chunk in verified.chunks]) - 1) * scale.point_s
    touching = np.append(plan.start_s[1:] - plan_end_s[:-1] < scale.point_s, False)
    for index in np.flatnonzero(plan.power_w >= scale.full_power_w / 255):
        parts = row == index
        assert pulses.start_s[parts].min() < plan.start_s[index] + scale.point_s
        assert end_s[parts].max() > plan_end_s[index] - (2 + parts.sum() + touching[index]) * scale.point_s
        on_s = pulses.width_s[parts].sum()
        cuts = ((blank_s > plan.start_s[index] - 1e-9) & (blank_s + scale.point_s < plan_end_s[index] + 1e-9)).sum()
        assert on_s > plan.width_s[index] - (2 + cuts + touching[index]) * scale.point_s - 1e-9
        assert pulses.power_w[parts].min() > plan.power_w[index] - scale.full_power_w / 255
    for frame in verified.chunks:
        points = raw_points(frame.data)
        assert frame.data[-1] == 2
        assert not points[-1, 3:].any()
        assert int.from_bytes(frame.data[-5:-3], "little") == rate
        assert len(frame.data) % 64
        assert frame.duration_s <= CHUNK_MAX_S


@settings(max_examples=60)
@given(st.data())
def test_plans_trimmed_by_the_limiter_pass_verification(data):
    """Overloaded trains on several pixels: quantisation to whole points exceeds no cap of the trimmed plan."""
    display = build_display(points_per_s=data.draw(st.sampled_from([20_000, 40_000, 50_000])))
    pixels = data.draw(st.lists(st.integers(0, 15), min_size=1, max_size=5, unique=True))
    trains = tuple(
        PulseTrain(
            pixel,
            data.draw(st.integers(0, 200)) * 1e-3,
            1.0,
            data.draw(st.integers(1, 250)) * 2e-4,
            data.draw(st.sampled_from([2e-4, 1e-3, 5e-3, 0.05])),
            2.45,
        )
        for pixel in pixels
    )
    plan, verified = build_verified(display, FrameSequence(trains=trains))
    assert verified.energy_j <= plan.energy_j.sum()


AT_THE_CAP = tuple(
    PulseTrain(pixel, at_s, 0.6, 2e-4, gap_s, 2.45) for pixel, at_s, gap_s in ((12, 0.013, 1e-3), (11, 0.009, 2e-4))
)
"""Trains whose number of moves makes the galvo cap remove pulses."""


def test_a_plan_at_the_galvo_cap_passes_verification():
    display = build_display()
    plan, verified = build_verified(display, FrameSequence(trains=AT_THE_CAP))
    assert (plan.reason == "galvo_acceleration").sum() > 10
    assert len(set(verified.row.tolist())) == np.count_nonzero(plan.power_w)


def test_without_the_interval_shrink_of_points_that_plan_is_rejected():
    """Mutant: a budget that ignores the shift of the mirror moves. Verification finds the galvo cap exceeded."""
    display = build_display()
    exact = display.budget._replace(galvos=display.budget.galvos._replace(timing_slack_s=np.zeros(1)))
    with pytest.raises(LocalProtocolError, match="galvo_acceleration"):
        build_verified(replace(display, budget=exact), FrameSequence(trains=AT_THE_CAP))


@settings(max_examples=60)
@given(sequences(), st.sampled_from([20_000, 33_333, 40_000, 50_000]))
def test_intervals_shrink_by_no_more_than_the_budget_assumes(sequence, rate):
    display = build_display(points_per_s=rate)
    plan, verified = build_verified(display, sequence)
    shrink_s, pulses, row = float(display.budget.galvos.timing_slack_s[0]), verified.pulses, verified.row
    begins, ends = np.unique(row, return_index=True)[1], len(row) - 1 - np.unique(row[::-1], return_index=True)[1]
    late_s = pulses.start_s[begins] - plan.start_s[row[begins]]
    early_s = (plan.start_s + plan.width_s)[row[ends]] - (pulses.start_s + pulses.width_s)[ends]
    assert late_s.max(initial=0.0) + early_s.max(initial=0.0) <= shrink_s + 1e-9


def test_mirrors_move_with_the_first_point_after_a_pulse():
    display = build_display()
    plan, verified = build_verified(display, build_frame(display))
    scale = PointScale.from_config(display.config)
    points = np.concatenate([raw_points(frame.data) for frame in verified.chunks]).astype(int)
    x, y, emitting = points[:, 0] << 4 | points[:, 1] >> 4, (points[:, 1] & 15) << 8 | points[:, 2], points[:, 6] > 0
    ends = np.flatnonzero(emitting[:-1] & ~emitting[1:]) + 1
    ends = ends[x[ends] != x[ends - 1]]
    codes = scale.to_codes(plan.x_rad), scale.to_codes(plan.y_rad)
    for end in ends:
        index = int(np.searchsorted(plan.start_s, end * scale.point_s, side="right"))
        assert (x[end], y[end]) == (codes[0][index], codes[1][index])
        assert end * scale.point_s <= plan.start_s[index - 1] + plan.width_s[index - 1] + 1e-9


def test_a_long_pulse_is_split_at_frame_ends_and_counts_as_one():
    display = build_display()
    plan, verified = build_verified(display, build_train(width_s=0.05, gap_s=0.2, duration_s=0.2))
    assert len(plan) == 1
    assert 2 <= len(verified.pulses) <= 4
    loss = 1 - verified.energy_j / plan.energy_j.sum()
    assert 0 < loss < 0.015


def test_adjacent_pulses_stay_separate():
    """Two single-pulse trains on one pixel, the second immediately after the first."""
    display = build_display()
    trains = tuple(PulseTrain(5, at_s, 0.002, 0.002, 0.0, 1.0) for at_s in (0.0, 0.002))
    plan, verified = build_verified(display, FrameSequence(trains=trains))
    assert plan.start_s[1] == pytest.approx(plan.start_s[0] + plan.width_s[0])
    assert verified.row.tolist() == [0, 1]
    assert (plan.width_s - verified.pulses.width_s < 3 * PointScale.from_config(display.config).point_s).all()


def test_a_plan_without_pulses_emits_nothing():
    display = build_display()
    plan, _ = limit(EMPTY_PLAN, display.build_cold_state()[1], display.budget)
    frames = encode(plan, PointScale.from_config(display.config))
    assert len(decode([frame.data for frame in frames], PointScale.from_config(display.config))) == 0
    frame = HeliosFormat(40_000).check(EMITTING * 2 + BLANK + GOOD)
    with pytest.raises(LocalProtocolError, match="exceeds the plan's pulses"):
        verify_chunks(
            [frame.data], plan, PointScale.from_config(display.config), display.build_cold_state()[1], display.budget
        )


def test_a_long_pause_consists_of_blank_frames():
    display = build_display()
    sequence = FrameSequence(trains=(PulseTrain(0, 0.0, 1.5, 1e-3, 1.0, 1.0),))
    _, verified = build_verified(display, sequence)
    assert len(verified.pulses) == 2
    assert verified.pulses.start_s[1] - verified.pulses.start_s[0] == pytest.approx(1.001, abs=26e-6)


GOOD = struct.pack("<HHB", 40_000, 3, 2)
EMITTING, BLANK = b"\x80\x08\x00" + b"\x01" * 4, b"\x80\x08\x00" + bytes(4)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (EMITTING * 2 + BLANK + struct.pack("<HHB", 40_000, 3, 0), "play once"),
        (EMITTING * 2 + BLANK + struct.pack("<HHB", 40_000, 3, 3), "flags 3"),
        (EMITTING * 3 + GOOD, "last point is not blank"),
        (EMITTING * 2 + b"\x80\x08\x00\x01\0\0\0" + GOOD, "last point is not blank"),
        (BLANK * 2 + GOOD, "for 3 points"),
        (BLANK * 1200 + struct.pack("<HHB", 40_000, 1200, 2), "the maximum is"),
        (BLANK * 3 + struct.pack("<HHB", 7, 3, 2), "the maximum is"),
        (BLANK * 3 + struct.pack("<HHB", 6, 3, 2), "accepts 7 to 65535"),
        (BLANK * 45 + struct.pack("<HHB", 40_000, 45, 2), "on which the Helios stalls"),
        (BLANK * 4096 + struct.pack("<HHB", 65_535, 4096, 2), "at most 4095"),
        (struct.pack("<HHB", 40_000, 0, 2), "holds no point"),
        (b"", "holds no point"),
    ],
)
def test_unsafe_frames_are_rejected(data, words):
    with pytest.raises(LocalProtocolError, match=words):
        HeliosFormat(40_000).check(data)


def _brighter(points):
    points[points[:, 6] > 0, 5] += 1  # one channel of four is enough


def _earlier(points):
    first = int(np.flatnonzero(points[:, 6])[0])
    points[first - 1] = points[first]


def _later(points):
    last = int(np.flatnonzero(points[:, 6])[-1])
    points[last + 1] = points[last]


def _shift(points):
    points[points[:, 6] > 0, 2] ^= 1


def _elsewhere(points):
    points[np.flatnonzero(points[:, 6])[0] + 1, 0] ^= 0x80


MUTANTS = [_brighter, _earlier, _later, _shift, _elsewhere]


@pytest.mark.parametrize("mutant", MUTANTS)
def test_mutants_of_the_bytes_fail_verification(mutant):
    display = build_display()
    scale, budget = PointScale.from_config(display.config), display.build_cold_state()[1]
    plan, verified = build_verified(display, build_frame(display))
    frames = [frame.data for frame in verified.chunks]
    verify_chunks(frames, plan, scale, budget, display.budget)
    number = next(index for index, data in enumerate(frames) if raw_points(data)[:-3, 6].any())
    points = raw_points(frames[number]).copy()
    mutant(points)
    frames[number] = points.tobytes() + frames[number][-5:]
    with pytest.raises(LocalProtocolError, match=r"exceeds the plan's pulses|last point"):
        verify_chunks(frames, plan, scale, budget, display.budget)


def test_an_unlimited_plan_fails_verification():
    display = build_display()
    scale, budget = PointScale.from_config(display.config), display.build_cold_state()[1]
    plan, _ = build_verified(display, build_train(width_s=0.04, gap_s=0.002, power_w=1.0, duration_s=0.5))
    hot = replace(plan, power_w=np.full(len(plan), scale.full_power_w))
    frames = [frame.data for frame in encode(hot, scale)]
    with pytest.raises(LocalProtocolError, match="passes a cap"):
        verify_chunks(frames, hot, scale, budget, display.budget)


def test_a_wrong_rate_fails_verification():
    """Mutant: frames at 50 kHz with points for 40 kHz."""
    display = build_display()
    scale, budget = PointScale.from_config(display.config), display.build_cold_state()[1]
    plan, verified = build_verified(display, build_frame(display))
    frames = [frame.data[:-5] + struct.pack("<H", 50_000) + frame.data[-3:] for frame in verified.chunks]
    with pytest.raises(LocalProtocolError, match="exceeds the plan's pulses"):
        verify_chunks(frames, plan, scale, budget, display.budget)


@pytest.mark.parametrize("transport", ["helios", "ether_dream", "idn"])
def test_levels_follow_the_curve_of_the_laser_and_reach_its_threshold(transport):
    """The light of each level by the laser's table is that of the plan, or less by at most a level."""
    rows = [[0.0, 0.0], [0.1, 0.0], [0.2, 0.3], [0.5, 0.8], [1.0, 2.45]]
    table = build_config(transport=transport, port="dac" if transport != "helios" else "").model_dump()
    table["laser"] |= {"curve": rows, "threshold_w": 0.3}
    display = DisplayModel.from_config(Config.model_validate(table))
    scale = PointScale.from_config(display.config)
    powers_w = np.geomspace(display.config.min_power_w, 2.45, 9)
    trains = tuple(PulseTrain(k, 0.1 * k, 0.01, 0.01, 0.01, float(power_w)) for k, power_w in enumerate(powers_w))
    plan = plan_sequence(display, FrameSequence(trains=trains), *display.build_cold_state()).plan
    tables = [scale.format.parse(chunk.data)[0] for chunk in encode(plan, scale)]
    levels = np.concatenate(tables)[:, 2] / scale.format.level_max
    emitted_w = np.interp(levels, *np.transpose(rows)) * scale.format.stretch
    found_w = emitted_w[levels > 0]
    found_w = found_w[np.append(True, np.diff(found_w) != 0)]
    step_w = 3.3 / scale.format.level_max * scale.format.stretch
    planned_w = plan.power_w[plan.power_w > 0]
    assert len(found_w) == len(planned_w) == 9
    assert (found_w <= planned_w * (1 + 1e-9)).all()
    assert (found_w > planned_w - step_w).all()
    assert found_w.min() >= 0.3 * scale.format.stretch * (1 - 1e-9)
