"""While the gate is on the whole focus lies on the absorber, for encoded plans and any servo within its uncertainty."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from displays import DISPLAYS
from focus_judge import compute_overhang_m, ideal_position_m
from hidden_field import calibrate_hidden_field
from optodrive.core.errors import InputError, LocalProtocolError
from optodrive.core.types.stimuli import FrameSequence, PulseTrain, TactileFrame
from optodrive.device.config import Config
from optodrive.device.config_file import load_config, locate_shipped
from optodrive.device.gate_timing import build_servo_range
from optodrive.device.settling import SettlingTable
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.dac.encoding import PointScale, decode, encode
from optodrive.link.dac.player import encode_verified, verify_chunks
from optodrive.link.protocol.quantisation import CENTRE_CODE, quantise
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.pipeline import plan_sequence
from optodrive.planning.stimuli.pattern_registry import build_pattern

ROUNDING_M = 1e-9
POINT_RATES = (20_000, 40_000, 50_000)
EXACT = {"bandwidth_uncertainty": 0.0, "damping_uncertainty": 0.0, "slew_uncertainty": 0.0, "delay_uncertainty_s": 0.0}
SLOWEST = (-1.0, 1.0, -1.0, 1.0)
"""Place of the servo that enters the tolerance last."""
PLACES = (SLOWEST, (1.0, -1.0, 1.0, -1.0), (-1.0, -1.0, -1.0, 1.0), (0.0, 0.0, 0.0, 0.0))


def overhang_m(display, plan, position_of=ideal_position_m, stage=0):
    """Return how far the focus, with its aim error, extends beyond an absorber's edge while the gate is on, m.

    It is negative if the focus never does.
    """
    scale = build_board_requirements(display.config).scale
    points = quantise(plan, scale, stage)
    x, y, dark, on, _ = points.table.astype(np.int64).T
    begin_s = np.concatenate([[0], np.cumsum(dark + on)[:-1]]) * scale.tick_s
    gate_on = np.flatnonzero(on)
    from_s, on_s = begin_s[gate_on] + dark[gate_on] * scale.tick_s, on[gate_on] * scale.tick_s
    angles_rad = scale.to_angles_rad(x), scale.to_angles_rad(y)
    return compute_overhang_m(display, begin_s, angles_rad, from_s, on_s, plan.pixel[points.row[gate_on]], position_of)


def with_servo(display, place):
    """Return the display with mirrors at a place within the declared uncertainty, from −1 to 1 in each half-width."""
    scanner = display.config.scanner
    servo = build_servo_range(scanner).servo_at(*place)
    changed = scanner.model_copy(
        update=EXACT
        | {
            "bandwidth_hz": servo.frequency,
            "damping": servo.damping,
            "slew_rad_per_s": servo.slew,
            "delay_s": max(0.0, servo.delay),
        }
    )
    return replace(display, config=display.config.model_copy(update={"scanner": changed}))


def max_overhang_m(display, plan, judge=None, places=PLACES, **options):
    """Return the largest overhang by mirrors at several places within the declared uncertainty, m."""
    return max((judge or overhang_m)(with_servo(display, place), plan, **options) for place in places)


def helios_overhang_m(display, plan):
    """Return the same for a Helios' points, decoded from the bytes of its frames."""
    scale = PointScale.from_config(display.config)
    frames = [frame.data for frame in encode(plan, scale)]
    points = np.concatenate([np.frombuffer(data[:-5], dtype=np.uint8).reshape(-1, 7) for data in frames]).astype(int)
    codes = points[:, 0] << 4 | points[:, 1] >> 4, (points[:, 1] & 15) << 8 | points[:, 2]
    begin = np.flatnonzero(np.append(True, (np.diff(codes[0]) != 0) | (np.diff(codes[1]) != 0)))
    angles = tuple(scale.to_angles_rad(code[begin]) for code in codes)
    pulses = decode(frames, scale)
    pixel = plan.pixel[np.searchsorted(plan.start_s, pulses.start_s + 1e-9, side="right") - 1]
    return compute_overhang_m(display, begin * scale.point_s, angles, pulses.start_s, pulses.width_s, pixel)


def plan_pulses(display, sequence):
    return plan_sequence(display, sequence, *display.build_cold_state()).plan


def change_display(name, **sections):
    table = DISPLAYS[name].config.model_dump()
    for section, values in sections.items():
        table[section] |= values
    return DisplayModel.from_config(Config.model_validate(table))


@st.composite
def displays(draw):
    """Sample small lattices with any admissible servo, focus and PWM."""
    name = "display-16"
    try:
        return change_display(
            name,
            display={
                "rows": draw(st.integers(1, 4)),
                "columns": draw(st.integers(1, 5)),
                "pitch_m": draw(st.floats(2.05e-3, 6e-3)),
            },
            laser={
                "pwm_hz": draw(st.sampled_from([5e3, 2e4, 5e4])),
                "focus_width_m": draw(st.floats(0.2e-3, 1.4e-3)),
                "focus_height_m": draw(st.floats(0.2e-3, 1.1e-3)),
            },
            scanner={
                "bandwidth_hz": draw(st.floats(300, 4000)),
                "damping": draw(st.floats(0.3, 0.9)),
                "delay_s": draw(st.floats(0.0, 2e-4)),
                "slew_rad_per_s": draw(st.floats(30, 500)),
                "aim_error_m": draw(st.sampled_from([0.0, 1e-4, 1.5e-4])),
                "bandwidth_uncertainty": draw(st.sampled_from([0.0, 0.03, 0.1])),
                "damping_uncertainty": draw(st.sampled_from([0.0, 0.03, 0.1])),
                "slew_uncertainty": draw(st.sampled_from([0.0, 0.1])),
                "delay_uncertainty_s": draw(st.sampled_from([0.0, 1e-5])),
            },
            limits={"galvo_acceleration_rms_max_rad_per_s2": draw(st.sampled_from([2e4, 1e5, 1e9]))},
        )
    except InputError:
        reject()


places = st.tuples(*[st.one_of(st.sampled_from([-1.0, 1.0]), st.floats(-1.0, 1.0))] * 4)


def random_pulses(draw, display):
    """Sample pulses of all widths on random pixels, one after the other, as trains of one pulse each."""
    period_s = 1.0 / display.config.laser.pwm_hz
    trains, at_s = [], 0.0
    for _ in range(draw(st.integers(2, 40))):
        pixel = draw(st.integers(0, len(display.layout) - 1))
        width_s = period_s * draw(st.sampled_from([1, 1, 1, 2, 3, 10, 60]))
        trains.append(PulseTrain(pixel, at_s, width_s, width_s, 0.0, draw(st.sampled_from([0.3, 2.45]))))
        at_s += width_s + draw(st.sampled_from([0.0, 0.0, 0.0, 1e-3, 0.2]))
    return trains


@settings(max_examples=2 * settings.default.max_examples)
@given(data=st.data())
def test_the_focus_lies_on_the_absorber_while_the_gate_is_on(data):
    display = data.draw(displays())
    sequence = FrameSequence(trains=tuple(random_pulses(data.draw, display)))
    servo = with_servo(display, data.draw(places))
    assert overhang_m(servo, plan_pulses(display, sequence)) <= ROUNDING_M


def full_frame(display, height_m):
    return FrameSequence((TactileFrame("full", 0.0, 10.0, np.full(len(display.layout), height_m)),))


@pytest.mark.parametrize(("name", "height_m"), [("display-1511", 50e-6), ("display-437", 10e-6), ("display-1", 50e-6)])
def test_in_a_full_frame(name, height_m):
    display = DISPLAYS[name]
    assert max_overhang_m(display, plan_pulses(display, full_frame(display, height_m))) <= ROUNDING_M


def draw_sequence(rng, display):
    """Return a frame of random heights, or pulses of random widths on random pixels."""
    count, period_s = len(display.layout), 1.0 / display.config.laser.pwm_hz
    if rng.random() < 0.5:
        target_m = np.where(rng.random(count) < rng.uniform(0.1, 1.0), rng.uniform(5e-6, 60e-6, count), 0.0)
        return FrameSequence((TactileFrame("random", 0.0, 60.0, target_m),))
    widths_s = period_s * rng.choice([1, 1, 2, 5, 20], 400)
    begins_s = np.cumsum(widths_s) - widths_s
    pixels = rng.integers(0, count, 400).tolist()
    rows = zip(pixels, begins_s.tolist(), widths_s.tolist(), strict=True)
    return FrameSequence(
        trains=tuple(PulseTrain(pixel, at_s, wide_s, wide_s, 0.0, 1.0) for pixel, at_s, wide_s in rows)
    )


def count_judged(name, count, seed):
    """Judge random plans with servos at random places of their uncertainty until `count` pulses are judged."""
    rng, display, pulses = np.random.default_rng(seed), DISPLAYS[name], 0
    while pulses < count:
        plan = plan_pulses(display, draw_sequence(rng, display))
        place = tuple(rng.choice([-1.0, 1.0, rng.uniform(-1.0, 1.0)], 4).tolist())
        assert overhang_m(with_servo(display, place), plan) <= ROUNDING_M, (name, seed, place)
        pulses += len(plan)
    return pulses


@pytest.mark.parametrize("name", ["display-16", "display-437"])
def test_random_plans_of_a_shipped_display(name):
    assert count_judged(name, 400, seed=1) >= 400


@pytest.mark.slow
@pytest.mark.timeout(0)
@pytest.mark.parametrize("part", range(5))
@pytest.mark.parametrize("name", ["display-16", "display-357", "display-437", "display-1511"])
def test_a_million_pulses_of_random_plans(name, part):
    assert count_judged(name, 50_000, seed=100 + part) >= 50_000


@pytest.mark.parametrize("name", sorted(EXACT))
def test_an_uncertainty_that_is_forgotten_is_caught(name):
    """Mutants: half of an uncertainty."""
    half_width = 3e-5 if name.endswith("_s") else 0.2
    display = change_display("display-16", scanner=EXACT | {name: half_width})
    loose = change_display("display-16", scanner=EXACT | {name: 0.5 * half_width})
    for planned, is_caught in ((display, False), (loose, True)):
        plan = plan_pulses(planned, full_frame(planned, 50e-6))
        assert (max_overhang_m(display, plan, places=(SLOWEST,)) > ROUNDING_M) == is_caught


def test_the_beams_of_several_stages(tmp_path):
    """Each beam has the settling times of its own mirrors; by those of the other, the slower one is caught."""
    stages = "".join(
        f'\n[[stages]]\nname = "{name}"\nscanner = {{ bandwidth_hz = {hz} }}\n'
        for name, hz in (("left", 1700.0), ("right", 1000.0))
    )
    path = tmp_path / "stages.toml"
    path.write_text(locate_shipped("display-437.toml").read_text() + stages)
    display = DisplayModel.from_config(load_config(path))
    left, right = (replace(display, config=config) for config in display.config.list_stage_configs())
    plan = plan_pulses(display, full_frame(display, 20e-6))
    assert set(plan.stage.tolist()) == {0, 1}
    for stage, beam in enumerate((left, right)):
        judges = [with_servo(beam, place) for place in PLACES]
        assert max(overhang_m(judge, plan, stage=stage) for judge in judges) <= ROUNDING_M
    assert overhang_m(with_servo(right, SLOWEST), plan, stage=0) > 1e-4


def helios_display(display, points_per_s, trajectories="steps"):
    """Return the same display behind a Helios."""
    table = display.config.model_dump()
    table["board"] |= {"transport": "helios", "points_per_s": points_per_s}
    table["scanner"] |= {"half_range_codes": 2047, "trajectories": trajectories}
    return DisplayModel.from_config(Config.model_validate(table))


@settings(max_examples=3 * settings.default.max_examples // 5)
@given(data=st.data())
def test_on_a_helios_whose_steps_are_coarse(data):
    try:
        rate, trajectories = (data.draw(st.sampled_from(each)) for each in (POINT_RATES, ("steps", "early_steps")))
        display = helios_display(data.draw(displays()), rate, trajectories)
    except InputError:
        reject()
    except ValidationError:  # two coarse steps and the focus do not fit on the absorber
        reject()
    sequence = FrameSequence(trains=tuple(random_pulses(data.draw, display)))
    servo = with_servo(display, data.draw(places))
    assert helios_overhang_m(servo, plan_pulses(display, sequence)) <= ROUNDING_M


@pytest.mark.parametrize("trajectories", ["steps", "early_steps"])
@pytest.mark.parametrize(("name", "height_m"), [("display-437", 10e-6), ("display-16", 50e-6)])
def test_on_a_helios_in_a_full_frame(name, height_m, trajectories):
    display = helios_display(DISPLAYS[name], 40_000, trajectories)
    plan = plan_pulses(display, full_frame(display, height_m))
    assert max_overhang_m(display, plan, helios_overhang_m) <= ROUNDING_M
    early = shorten_settling(display, 0.75)  # whole points are up to 8 % longer
    plan = plan_pulses(early, full_frame(early, 50e-6))
    assert max_overhang_m(early, plan, helios_overhang_m, (SLOWEST,)) > 2e-5


def test_early_steps_save_their_time():
    plain, early = (helios_display(DISPLAYS["display-16"], 50_000, each) for each in ("steps", "early_steps"))
    ends_s = [plan_pulses(each, full_frame(each, 50e-6)).end_s for each in (plain, early)]
    assert early.scan_head.settling.early_points == 4
    assert ends_s[0] - ends_s[1] == pytest.approx(15 * 79e-6, abs=1e-9)


def hurry_steps(display, monkeypatch, **changes):
    """Return the display with other early steps, in the plan and in its points."""
    scale = replace(PointScale.from_config(display.config), **changes)
    monkeypatch.setattr(PointScale, "from_config", lambda _config: scale)
    early_us = int(1e6 * scale.early_points * scale.point_s) - 1
    settling = replace(display.scan_head.settling, long_dwell_us=0, early_us=early_us, **changes)
    return with_settling(display, settling)


def test_a_step_that_leaves_too_early_is_caught(monkeypatch):
    """Mutant: two points more."""
    display = helios_display(DISPLAYS["display-16"], 50_000, "early_steps")
    early = hurry_steps(display, monkeypatch, early_points=6)
    assert max_overhang_m(display, plan_pulses(early, full_frame(early, 50e-6)), helios_overhang_m) > 1e-5


def test_a_step_that_leaves_before_the_mirrors_rest_is_caught(monkeypatch):
    """Mutant: steps as early as after a long rest also after the shortest pulses."""
    servo = EXACT | {"damping": 0.3, "bandwidth_hz": 400.0, "slew_rad_per_s": 300.0}
    display = helios_display(change_display("display-16", scanner=servo), 50_000, "early_steps")
    assert max_overhang_m(display, plan_pulses(display, shortest_pulses(display)), helios_overhang_m) <= ROUNDING_M
    early = hurry_steps(display, monkeypatch, early_dwell_us=0, early_points=8)
    assert max_overhang_m(display, plan_pulses(early, shortest_pulses(early)), helios_overhang_m) > 1e-5


def test_bytes_with_a_step_in_the_midst_of_light_are_refused():
    display = helios_display(DISPLAYS["display-16"], 40_000, "early_steps")
    (_, state), scale = display.build_cold_state(), PointScale.from_config(display.config)
    plan = plan_pulses(display, full_frame(display, 50e-6))
    encode_verified(plan, scale, state, display.budget)
    for early in (replace(scale, early_points=4), replace(scale, early_dwell_us=0)):
        sequence = full_frame(display, 50e-6) if early.early_dwell_us else shortest_pulses(display)
        chunks = [each.data for each in encode(plan_pulses(display, sequence), early)]
        with pytest.raises(LocalProtocolError, match="exceeds the plan's pulses"):
            verify_chunks(chunks, plan_pulses(display, sequence), scale, state, display.budget)


@pytest.mark.parametrize("number", range(1, 7))
def test_in_the_experiments_of_the_paper(number):
    display = DISPLAYS["display-437"]
    plan = plan_pulses(display, build_pattern(f"experiment-{number}", {}, display.config))
    assert max_overhang_m(display, plan, places=(SLOWEST, (1.0, -1.0, 1.0, -1.0))) <= ROUNDING_M


def with_settling(display, settling):
    return replace(display, scan_heads=(replace(display.scan_head, settling=settling),))


def shorten_settling(display, share=0.85):
    """Return a display whose settling times open the gate early, by default by 15 %."""
    settling = display.scan_head.settling
    after_long_dwell, after_short_dwell = (
        tuple(tuple(int(share * time_us) for time_us in times_us) for times_us in tables)
        for tables in (settling.after_long_dwell, settling.after_short_dwell)
    )
    early = replace(settling, after_long_dwell=after_long_dwell, after_short_dwell=after_short_dwell)
    return with_settling(display, early)


@pytest.mark.parametrize("name", ["display-16", "display-437"])
def test_a_gate_that_opens_earlier_is_caught(name):
    display = DISPLAYS[name]
    early = shorten_settling(display)
    plan = plan_pulses(early, full_frame(early, 50e-6))
    assert max_overhang_m(early, plan, places=(SLOWEST,)) > 2e-5


def shortest_pulses(display):
    """Return the shortest pulses on pixels of the first row, as fast as the mirrors settle."""
    width_s = 1.0 / display.config.laser.pwm_hz
    pixels = [k % display.config.display.columns for k in range(60)] + [k % 2 for k in range(60)]
    return FrameSequence(
        trains=tuple(PulseTrain(p, 1e-6 * k, width_s, width_s, 0.0, 2.45) for k, p in enumerate(pixels))
    )


def test_moves_after_a_short_dwell_taken_for_long_ones_are_caught():
    """A servo that rings, and pulses of 20 µs."""
    ringing = EXACT | {"damping": 0.3, "bandwidth_hz": 400.0, "slew_rad_per_s": 300.0}
    display = change_display(
        "display-16",
        scanner=ringing,
        display={"pitch_m": 2.1e-3},
        laser={"pwm_hz": 5e4},
        limits={"galvo_acceleration_rms_max_rad_per_s2": 1e9},
    )
    assert overhang_m(display, plan_pulses(display, shortest_pulses(display))) <= 0
    always_long_dwell = with_settling(display, replace(display.scan_head.settling, long_dwell_us=0))
    assert overhang_m(always_long_dwell, plan_pulses(always_long_dwell, shortest_pulses(always_long_dwell))) > 2e-5


def field_position_m(display, x_rad, y_rad):
    """Return the beam's position with the calibrated field."""
    step_rad = display.config.scanner.rad_per_code
    return display.scan_head.field.position_m(CENTRE_CODE + x_rad / step_rad, CENTRE_CODE + y_rad / step_rad)


@pytest.fixture(scope="module")
def field_display(tmp_path_factory):
    """Display-437 with a field calibrated on a hidden geometry."""
    _, config = calibrate_hidden_field(tmp_path_factory.mktemp("field") / "field.toml", seed=3)
    return DisplayModel.from_config(config)


def random_sequence(display):
    """Return short pulses on random pixels."""
    pixels = np.random.default_rng(6).integers(0, len(display.layout), 300).tolist()
    return FrameSequence(trains=tuple(PulseTrain(p, 1e-6 * k, 2e-4, 2e-4, 0.0, 2.45) for k, p in enumerate(pixels)))


def test_in_a_calibrated_field(field_display):
    for sequence in (full_frame(field_display, 10e-6), shortest_pulses(field_display), random_sequence(field_display)):
        plan = plan_pulses(field_display, sequence)
        assert max_overhang_m(field_display, plan, places=(SLOWEST,), position_of=field_position_m) <= ROUNDING_M


def test_settling_times_of_the_ideal_lattice_in_a_calibrated_field_are_caught(field_display):
    """Settling times of the nominal pitch are applied to positions slightly farther apart."""
    ideal_settling = SettlingTable.from_config(field_display.config)
    loose = with_settling(field_display, replace(ideal_settling, pitch_rad=1.2 * ideal_settling.pitch_rad))
    plan = plan_pulses(loose, random_sequence(loose))
    assert max_overhang_m(loose, plan, places=(SLOWEST,), position_of=field_position_m) > ROUNDING_M
