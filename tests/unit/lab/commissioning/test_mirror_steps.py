"""Mirror steps in virtual time: gate off by the board's log, exact times, and the calibration from them."""

from dataclasses import replace

import numpy as np
import pytest

from displays import DISPLAYS
from exclusive_rig import ExclusiveRig, limited
from hidden_servo import HiddenServo
from optodrive.core.errors import InputError, LinkError, LocalProtocolError
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.device.config import Config
from optodrive.lab.commissioning import mirror_steps
from optodrive.lab.commissioning.mirror_steps import LEAD_IN_S, plan_step_runs, play_step_runs
from optodrive.lab.servo_identification.identify import identify
from optodrive.lab.servo_identification.records import extract_trace
from optodrive.link.protocol.quantisation import WirePoints
from optodrive.planning.display_model import DisplayModel

STEPS = 12


class Rig(ExclusiveRig):
    """A rig that keeps the commands which the converter received: at_us, x and y code."""

    def __init__(self, display):
        self.moves = []
        super().__init__(display, self.keep)

    def keep(self, x_code, y_code, at_us):
        self.moves.append((at_us, x_code, y_code))

    def play(self, pause_s=0.1):
        played = []
        with self.armed() as held:
            runs = plan_step_runs(held, STEPS)
            play_step_runs(runs, held, pause_s, lambda run, commands: played.append((run, commands)))
        return played


def judge_dark(log):
    """Return whether the board's log states that the gate never opened."""
    return not [event for event in log if event["event"] in ("gate", "pulse")]


def replace_points(monkeypatch, change):
    """Replace the points of the steps by mutants."""
    build = mirror_steps.build_gate_off_points

    def mutate(run, scale):
        points = build(run, scale)
        return WirePoints(change(points.table.copy()), points.row)

    monkeypatch.setattr(mirror_steps, "build_gate_off_points", mutate)


def open_gate(table):
    table[5, 3:] = 100, 600
    return table


def test_the_gate_stays_off_and_commands_are_at_the_reported_times(any_display):
    rig = Rig(any_display)
    played = rig.play()
    assert judge_dark(rig.log)
    assert rig.core.state == "DISARMED"
    scale = rig.held.session.scale
    at_us, x_code, _ = np.array(rig.moves).T
    moved = np.flatnonzero(np.diff(x_code, prepend=x_code[0]))
    for run, commands in played:
        assert commands[1, 0] == LEAD_IN_S
        assert commands[:, 1:] == pytest.approx(scale.to_angles_rad(run.codes))
        assert (np.abs(np.diff(commands[:, 1])) > 0.0).all()
        codes = run.codes[:, 0]
        starts = [row for row in moved if (x_code[moved[moved >= row]][:STEPS].tolist() == codes[1:].tolist())]
        assert len(starts) == 2
        first = starts[run.name.endswith("b")]
        steps = moved[moved >= first][:STEPS]
        assert at_us[steps] - at_us[first] == pytest.approx((commands[1:, 0] - LEAD_IN_S) * 1e6, abs=0.5)
    sizes = [np.ptp(run.codes[:, 0]) for run, _ in played]
    assert sizes[:3] == sizes[3:] == sorted(sizes[:3], reverse=True)


def test_a_mutant_that_opens_the_gate_is_refused_before_it_is_sent(display, monkeypatch):
    replace_points(monkeypatch, open_gate)
    rig = Rig(display)
    with pytest.raises(LocalProtocolError, match="1 points with the gate on, expected 0"):
        rig.play()
    assert judge_dark(rig.log)
    assert rig.core.state == "DISARMED"


def test_the_log_shows_a_mutant_that_opens_the_gate_unchecked(display, monkeypatch):
    """Without the check the same mutant emits, and the judge of the other tests sees it."""
    replace_points(monkeypatch, open_gate)
    rig = Rig(display)
    monkeypatch.setattr(rig.held, "_verify_encoded", lambda *arguments, **options: None)
    with pytest.raises(LinkError, match="µs late"):
        rig.play()
    assert not judge_dark(rig.log)


def test_steps_wait_for_the_galvo_cap(display):
    cap = display.config.limits.galvo_acceleration_rms_max_rad_per_s2
    fast, slow = (
        plan_step_runs(Rig(each).held, STEPS)[0].hold_ticks[1:]
        for each in (display, limited(display, galvo_acceleration_rms_max_rad_per_s2=0.2 * cap))
    )
    assert fast.min() >= 15_000
    assert slow.min() > 2 * fast.min()


@pytest.mark.parametrize(
    ("section", "values"),
    [
        ("scanner", {"range_rad": 0.0137}),  # the display and a sixth of a millimetre
        ("display", {"missing": [[row, column] for row in range(4) for column in range(3)]}),
        ("scanner", {"slew_rad_per_s": 1.0}),
    ],
    ids=["narrow scanner", "pixels aside", "slow servo"],
)
def test_steps_of_a_display_of_one_s_own_stay_on_the_board_s_field(section, values):
    table = DISPLAYS["display-16"].config.model_dump()
    table[section] |= values
    rig = Rig(DisplayModel.from_config(Config.model_validate(table)))
    played = rig.play()
    assert [run.name for run, _ in played] == ["size1", "size2", "size3", "size1b", "size2b", "size3b"]
    assert judge_dark(rig.log)


def test_steps_that_never_fit_are_refused(display):
    rig = Rig(limited(display, galvo_acceleration_rms_max_rad_per_s2=1.3e4))
    with pytest.raises(InputError, match=r"galvo_acceleration_rms_max_rad_per_s2: got 13000\.0"):
        plan_step_runs(rig.held, STEPS)
    with pytest.raises(InputError, match="--steps: got 5, expected 6 to 100"):
        plan_step_runs(Rig(display).held, 5)


def test_a_late_step_is_refused(display, monkeypatch):
    """A move that the board holds longer for settling than planned would be recorded with a wrong time."""

    def shorten(table):
        table[5, 2] = 200  # less than the mirrors' settling time, which the board awaits
        return table

    replace_points(monkeypatch, shorten)
    with pytest.raises(LinkError, match="µs late: play the steps again"):
        Rig(display).play()


def test_a_calibration_finds_the_servo_in_the_recorded_steps():
    rig, servos = (
        Rig(DISPLAYS["display-437"]),
        (HiddenServo(900.0, 0.6, 4e-5, 90.0), HiddenServo(1400.0, 0.5, 2e-5, 80.0)),
    )
    random, runs = np.random.default_rng(2), []
    for run, commands in rig.play():
        t_s = np.arange(0.0, commands[-1, 0] + 0.015, 2e-5)
        signals = {
            f"mirror_{axis}_rad": Signal(0, t_s, servo.follow(commands[:, 0], commands[:, 1 + k], t_s))
            for k, (axis, servo) in enumerate(zip("xy", servos, strict=True))
        }
        noisy = {
            name: replace(signal, value=signal.value + 1e-5 * random.standard_normal(len(t_s)))
            for name, signal in signals.items()
        }
        runs.append(Run(run.name, 295.0, np.zeros((0, 4)), noisy, {}, commands))
    measurement = Measurement(tuple(runs))
    for axis, servo in enumerate(servos):
        found = identify("steps", extract_trace("steps", measurement, axis), 100.0).servo
        assert found.frequency == pytest.approx(servo.hz, rel=0.03)
        assert found.delay == pytest.approx(servo.delay_s, abs=1e-5)
        assert found.slew == pytest.approx(servo.slew, rel=0.03)
