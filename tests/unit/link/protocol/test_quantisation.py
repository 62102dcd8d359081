from dataclasses import replace

import numpy as np
import pytest

from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.plans import EMPTY_PLAN, LimitedPlan
from optodrive.link.protocol.quantisation import CENTRE_CODE, GATE_OFF_STEP_TICKS, WireScale, decode, quantise

SCALE = WireScale(rad_per_code=0.1745 / 32767, full_power_w=2.45, tick_s=1e-6)


def plan(*pulses):
    """A limited plan of (start_s, width_s, x_rad, y_rad, power_w)."""
    start, width, x, y, power = np.array(pulses, dtype=float).reshape(-1, 5).T
    n = len(start)
    return LimitedPlan(
        **{
            **vars(EMPTY_PLAN),
            "start_s": start,
            "width_s": width,
            "x_rad": x,
            "y_rad": y,
            "power_w": power,
            "pixel": np.arange(n),
            "stage": np.zeros(n, dtype=np.int64),
        },
        energy_j=width * power,
        trimmed_j=np.zeros(n),
        reason=np.full(n, ""),
        headroom_k=np.zeros(n),
    )


def payload(points):
    return points.encode_payload()


def back(limited):
    return decode(payload(quantise(limited, SCALE)), SCALE)


def random_plan(n=500, seed=3):
    rng = np.random.default_rng(seed)
    width = rng.integers(1, 251, n) * 200e-6
    gap = np.rint(rng.choice([0.0, 4e-4, 0.003, 0.2], n) * 1e6) * 1e-6
    start = np.rint(np.cumsum(gap + width) * 1e6 - np.rint(width * 1e6)) * 1e-6
    angles = rng.uniform(-0.17, 0.17, (2, n))
    return plan(*zip(start, width, *angles, rng.uniform(1e-3, 2.45, n), strict=True))


def test_times_are_recovered_to_1e_12():
    limited = random_plan()
    read = back(limited)
    assert len(read.start_s) == 500
    assert np.abs(read.start_s - limited.start_s).max() < 1e-12
    assert np.abs(read.width_s - limited.width_s).max() < 1e-12


def test_rounding_errors_of_starts_do_not_accumulate():
    start = np.arange(2000) * 0.0030003  # 300 ns more off the tick at each pulse
    read = back(plan(*((s, 0.001, 0, 0, 1) for s in start)))
    assert np.abs(read.start_s - start).max() <= 0.5e-6 + 1e-12


def test_angles_are_recovered_to_half_a_code():
    limited = random_plan()
    read = back(limited)
    for axis in ("x_rad", "y_rad"):
        assert np.abs(getattr(read, axis) - getattr(limited, axis)).max() <= 0.5001 * SCALE.rad_per_code


def test_duty_is_rounded_down_and_full_power_is_full():
    limited = random_plan()
    read = back(limited)
    missing_w = limited.power_w - read.power_w
    assert missing_w.min() > -1e-11
    assert missing_w.max() < 2.45 / 65535 * 1.0001
    assert back(plan((0, 0.001, 0, 0, 2.45))).power_w[0] == pytest.approx(2.45, rel=1e-15)


def test_index_counts_points_and_row_the_pulses():
    limited = plan((0.5, 0.001, 0, 0, 1), (0.502, 0.001, 0, 0, 0), (0.504, 0.001, 0, 0, 1))
    points = quantise(limited, SCALE)
    assert points.row.tolist() == [-1] * 8 + [0, 1, 2]
    assert decode(payload(points), SCALE).index.tolist() == [8, 10]


def test_a_long_gap_becomes_gate_off_points_at_the_next_position():
    points = quantise(plan((0.0, 0.001, 0.1, 0, 1), (0.301, 0.001, -0.1, 0, 1)), SCALE)
    first, *gaps, last = points.table.tolist()
    assert gaps == [[last[0], last[1], GATE_OFF_STEP_TICKS, 0, 0]] * 4
    assert last[2] == 300_000 - 4 * GATE_OFF_STEP_TICKS
    assert first[0] > CENTRE_CODE > last[0]


@pytest.mark.parametrize(("gap_us", "gate_off_points"), [(65_535, 0), (65_536, 1), (125_535, 1), (125_536, 2)])
def test_the_edges_of_a_long_gap(gap_us, gate_off_points):
    limited = plan((0.0, 0.001, 0, 0, 1), (0.001 + gap_us * 1e-6, 0.001, 0, 0, 1))
    assert len(quantise(limited, SCALE)) == 2 + gate_off_points
    assert back(limited).start_s[1] == pytest.approx(0.001 + gap_us * 1e-6, abs=1e-12)


def test_the_first_of_pulses_without_power_lasts_until_the_next_light():
    """A board ends no point before the mirrors have settled: a shorter one would delay the light."""
    limited = plan((0.001, 0.02, 0.1, 0, 0.0), (0.021, 0.02, 0.1, 0, 1e-9), (0.0415, 0.05, 0.1, 0, 1.0))
    points = quantise(limited, SCALE)
    assert points.table[:, 2:].tolist() == [[41_500, 0, 0], [0, 0, 0], [0, 50_000, int(65535 / 2.45)]]
    assert points.row.tolist() == [0, 1, 2]
    assert decode(payload(points), SCALE).start_s == pytest.approx([0.0415], abs=1e-12)


def test_pulses_without_power_behind_the_last_light_are_equally_long_gate_off_points():
    limited = plan((0.001, 0.05, 0.1, 0, 1.0), (0.0515, 0.02, 0.1, 0, 0.0), (0.0715, 0.02, 0.1, 0, 0.0))
    assert quantise(limited, SCALE).table[:, 2:4].tolist() == [[1000, 50_000], [20_500, 0], [20_000, 0]]


def test_payloads_contain_whole_points():
    points = quantise(random_plan(100), SCALE)
    assert len(points.encode_payload()) == 10 * len(points)
    assert points.encode_payload(3, 4) == points.encode_payload()[30:70]
    assert points.encode_payload()[:10] == points.table[0].astype("<u2").tobytes()


def test_point_ends_and_counts():
    limited = plan((0.001, 0.05, 0.1, 0, 1.0), (0.3, 0.05, 0.1, 0, 0.0), (0.4, 0.05, 0.1, 0, 1.0))
    points = quantise(limited, SCALE)
    assert points.row.tolist() == [0, -1, -1, -1, -1, -1, 1, 2]
    assert points.compute_end_ticks()[[0, 6, 7]].tolist() == [51_000, 400_000, 450_000]
    assert [points.count_before(row) for row in range(4)] == [0, 1, 7, 8]


def test_an_empty_plan_has_no_points():
    points = quantise(plan(), SCALE)
    assert len(points) == 0
    assert points.encode_payload() == b""
    assert len(decode(b"", SCALE).index) == 0


@pytest.mark.parametrize(
    ("pulses", "says"),
    [
        ([(0, 0.001, 0.18, 0, 1)], "leave the DAC's range"),
        ([(0, 0.001, 0, -0.18, 1)], "leave the DAC's range"),
        ([(0, 0.010, 0, 0, 1), (0.009, 0.01, 0, 0, 1)], "overlap"),
        ([(0.02, 0.001, 0, 0, 1), (0.01, 0.001, 0, 0, 1)], "overlap"),
        ([(-1e-6, 0.001, 0, 0, 1)], "before the plan"),
        ([(0, 0.0656, 0, 0, 1)], "does not fit a point"),
        ([(0, 0.0, 0, 0, 1)], "does not fit a point"),
        ([(0, 0.001, 0, 0, 2.46)], "does not fit a point"),
        ([(0, 0.001, 0, 0, -0.1)], r"a pulse of 0\.001 s at -0\.1 W does not fit a point"),
    ],
)
def test_a_plan_that_does_not_fit_the_wire_is_a_local_error(pulses, says):
    with pytest.raises(LocalProtocolError, match=says):
        quantise(plan(*pulses), SCALE)


def test_pulses_may_touch():
    limited = plan((0, 0.01, 0, 0, 1), (0.01, 0.01, 0, 0, 1))
    assert quantise(limited, SCALE).table[:, 2].tolist() == [0, 0]


def test_decoding_detects_a_changed_byte():
    limited = plan((0.001, 0.01, 0.05, 0, 1.0))
    wire = bytearray(payload(quantise(limited, SCALE)))
    wire[6] ^= 1
    read = decode(bytes(wire), SCALE)
    assert read.width_s[0] != pytest.approx(limited.width_s[0], abs=1e-7)


def test_codes_and_angles_are_inverse():
    codes = np.arange(0, 65536, 7)
    assert SCALE.to_codes(SCALE.to_angles_rad(codes)).tolist() == codes.tolist()
    coarse = replace(SCALE, rad_per_code=1e-3)
    assert coarse.to_codes(np.array([0.0, 0.0006])).tolist() == [CENTRE_CODE, CENTRE_CODE + 1]


def test_mirrors_skip_pulses_trimmed_to_zero():
    limited = plan((0.001, 0.002, 0.01, 0.0, 1.0), (0.004, 0.002, 0.15, 0.1, 0.0), (0.008, 0.002, 0.02, 0.0, 1.0))
    points = quantise(limited, SCALE)
    x_rad = SCALE.to_angles_rad(points.table[:, 0].astype(np.int64))
    assert x_rad == pytest.approx([0.01, 0.02, 0.02], abs=1e-5)
    last = quantise(plan((0.001, 0.002, 0.01, 0.0, 1.0), (0.004, 0.002, 0.15, 0.1, 0.0)), SCALE)
    assert SCALE.to_angles_rad(last.table[:, 0].astype(np.int64)) == pytest.approx([0.01, 0.01], abs=1e-5)
