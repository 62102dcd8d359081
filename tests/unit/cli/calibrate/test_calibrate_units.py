"""Recordings of a pixel sweep or of mirror steps with a quantity in a wrong unit are refused in one line."""

from dataclasses import replace

import numpy as np
import pytest
from shown_output import COMPILATION

from displays import DISPLAYS
from optodrive.cli.main import run
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.device.servo import Servo, simulate_servo
from optodrive.lab.recording import write_recording

PREDICT = DISPLAYS["display-16"].build_cold_heat().simulate_displacement_m
T_S = np.arange(0.0, 0.12, 1e-3)
DEGREES = 180.0 / np.pi


def sweep():
    """Return a run of each of four pixels, with noise."""
    rng, runs = np.random.default_rng(5), []
    for pixel in range(4):
        pulses = np.array([[0.02, 0.01, 2.0, pixel]])
        value = PREDICT(pulses, pixel, T_S) + 1e-6 * rng.standard_normal(len(T_S))
        attributes = {"aim_x_m": 0.0, "aim_y_m": 2e-4}
        runs.append(Run(f"r{pixel}", 293.0, pulses, {"displacement_m": Signal(pixel, T_S, value)}, attributes))
    return Measurement(tuple(runs))


def mirror_steps():
    """Return one run of both mirrors, which step independently."""
    t_s = np.arange(0.0, 0.2, 2e-5)
    commands = np.column_stack([np.arange(40) * 5e-3, *np.random.default_rng(6).uniform(-0.15, 0.15, (2, 40))])
    servo = Servo(frequency=1200.0, damping=0.7, delay=5e-5, slew=150.0)
    signals = {
        f"mirror_{axis}_rad": Signal(0, t_s, simulate_servo(commands[:, 0], commands[:, column], t_s, servo))
        for column, axis in enumerate("xy", start=1)
    }
    return Measurement((Run("steps", 293.0, np.zeros((0, 4)), signals, {}, commands),))


def convert_signals(times=1.0, values=1.0):
    def change(run):
        signals = {
            name: replace(signal, t_s=signal.t_s * times, value=signal.value * values)
            for name, signal in run.signals.items()
        }
        return replace(run, signals=signals)

    return change


def convert_pulses(*factors):
    return lambda run: replace(run, pulses=run.pulses * [*factors, 1.0])


def convert_commands(*factors):
    return lambda run: replace(run, commands=run.commands * factors)


def convert_aim(run):
    return replace(run, attributes=run.attributes | {"aim_y_m": run.attributes["aim_y_m"] * 1e6})


CASES = {
    ("pixels", "displacement_m", "µm"): convert_signals(values=1e6),
    ("pixels", "displacement_m", "mm"): convert_signals(values=1e3),
    ("pixels", "displacement_m/t_s", "ms"): convert_signals(times=1e3),
    ("pixels", "power_W", "mW"): convert_pulses(1.0, 1.0, 1e3),
    ("pixels", "width_s", "ms"): convert_pulses(1.0, 1e3, 1.0),
    ("pixels", "start_s and width_s", "ms"): convert_pulses(1e3, 1e3, 1.0),
    ("pixels", "aim_y_m", "µm"): convert_aim,
    ("pixels", "ambient_K", "°C"): lambda run: replace(run, ambient_k=run.ambient_k - 273.15),
    ("servo", "mirror_x_rad", "degrees"): convert_signals(values=DEGREES),
    ("servo", "mirror_x_rad/t_s", "ms"): convert_signals(times=1e3),
    ("servo", "x_rad", "degrees"): convert_commands(1.0, DEGREES, 1.0),
    ("servo", "commands: t_s", "ms"): convert_commands(1e3, 1.0, 1.0),
}
RECORDINGS = {"pixels": sweep, "servo": mirror_steps}


def calibrate(command, folder, measurement):
    write_recording(folder / "recording", measurement)
    return run(["calibrate", command, str(folder / "recording"), "--config", "display-16"])


@pytest.mark.parametrize(("command", "quantity", "unit"), CASES, ids=lambda part: part.replace("/", " "))
def test_a_recording_in_a_wrong_unit_is_refused_in_one_line(command, quantity, unit, tmp_path, capsys):
    wrong = Measurement(tuple(CASES[command, quantity, unit](item) for item in RECORDINGS[command]().runs))
    assert calibrate(command, tmp_path, wrong) == 2
    error = COMPILATION.sub("", capsys.readouterr().err).strip()
    assert "\n" not in error
    assert quantity in error
    assert f"likely in {unit}" in error


@pytest.mark.parametrize(
    "command", [pytest.param(name, marks=pytest.mark.slow if name == "servo" else ()) for name in RECORDINGS]
)
def test_a_sound_recording_is_calibrated(command, tmp_path, capsys):
    assert calibrate(command, tmp_path, RECORDINGS[command]()) == 0, capsys.readouterr().err
