"""One linear servo or not: hidden servos with and without an effect, of other code and other forms."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from hidden_nonlinear_servo import EFFECT_OF, KINDS, HiddenServo, recording

from displays import DISPLAYS
from exclusive_rig import ExclusiveRig
from hidden_servo import HiddenServo as LinearServo
from hidden_servo import recording as step_recording
from optodrive.cli.main import run
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.device.config_file import load_config
from optodrive.lab.commissioning.mirror_steps import plan_step_runs, play_step_runs
from optodrive.lab.inference.noise import estimate_noise
from optodrive.lab.recording import write_recording
from optodrive.lab.servo_identification.effect_fit import LINEAR, find_effect
from optodrive.lab.servo_identification.gate import move_sizes_rad
from optodrive.lab.servo_identification.identify import identify
from optodrive.lab.servo_identification.records import DIFFERENCES, extract_records, extract_trace
from optodrive.link.simulator.galvos import measure_position_outputs

FORMS = ("multisine", "noise", "sweep", "holds")


def judge(kind, seed):
    """Return the name given to a hidden servo, None if no name is certain, and the answer."""
    random = np.random.default_rng(seed)
    servo = HiddenServo.sample(kind, random)
    form, noise = FORMS[random.integers(4)], float(np.exp(random.uniform(np.log(0.002), np.log(0.05))))
    records = extract_records("r", recording((servo, servo), random, form, noise=noise), 0)
    found = find_effect(records, 2.0 * np.pi * servo.hz * random.uniform(0.7, 1.4))
    return found.effect, found


@pytest.mark.parametrize("kind", ["linear with a lag", "slew", "arctangent", "smooth friction", "play", "Duffing"])
def test_an_effect_is_named_or_none(kind):
    name, found = judge(kind, 40)
    assert name == (EFFECT_OF[kind] or LINEAR)
    assert (found.gain > 0.5) is (name != LINEAR)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_of_68_hidden_servos_at_most_one_gets_a_false_name():
    answers = [
        (kind, judge(kind, 50_000 + 100 * repeat + row)[0]) for repeat in range(4) for row, kind in enumerate(KINDS)
    ]
    wrong = [(kind, name) for kind, name in answers if name not in (None, EFFECT_OF[kind] or LINEAR)]
    assert len(wrong) <= 1, wrong
    assert sum(name is not None for _, name in answers) >= 55, answers


def test_noise_is_that_of_white_samples_on_a_smooth_response():
    random, t_s = np.random.default_rng(3), np.arange(5000) / 25.0
    value = np.sin(2.0 * np.pi * t_s) + 0.01 * random.standard_normal(5000)
    assert estimate_noise([value], DIFFERENCES) == pytest.approx(0.01, rel=0.05)


def calibrate(folder, capsys, servo, name):
    other = HiddenServo("linear", 0.0, 1200.0, 0.5, 3e-5)
    measured = recording(
        (servo, other), np.random.default_rng(7), amplitudes_rad=(0.004, 0.012, 0.04), noise=0.01, count=2048
    )
    write_recording(folder / f"{name}.h5", measured)
    out = folder / f"{name}.toml"
    assert run(["calibrate", "servo", f"{folder}/{name}.h5", "--json", "--out", str(out)]) == 0
    return json.loads(capsys.readouterr().out), out


@pytest.fixture
def frames(tmp_path):
    path = tmp_path / "frames.json"
    path.write_text('{"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"17": 50, "300": 60}}]}')
    return path


def test_friction_beyond_the_gate_is_refused_by_name(tmp_path, capsys, frames):
    report, out = calibrate(tmp_path, capsys, HiddenServo("Coulomb", 0.05, 900.0, 0.6, 4e-5), "stuck")
    assert report["effect"]["name"] == ["dry_friction", "linear"]
    assert report["axes"]["x"]["linearity"]["probability"]["linear"] < 0.01
    assert report["axes"]["y"]["linearity"]["probability"]["linear"] > 0.95
    assert run(["plan", str(frames), "--mirrors", str(out)]) == 2
    assert "dry_friction of mirror x leaves an error that no settling time removes" in capsys.readouterr().err


def test_a_small_friction_is_planned_with_and_takes_longer_to_settle(tmp_path, capsys, frames):
    def settling_s(path):
        assert run(["plan", str(frames), "--json", "--mirrors", str(path)]) == 0
        return json.loads(capsys.readouterr().out)["settling_s"]

    report, out = calibrate(tmp_path, capsys, HiddenServo("Coulomb", 0.006, 900.0, 0.6, 4e-5), "stiff")
    assert report["effect"]["name"] == ["dry_friction", "linear"]
    # The loop pulls by the distance from the target: the mirror may rest where friction balances that.
    assert 0.8 * 0.006 * 0.04 < report["effect"]["error_rad"][0] < 1.6 * 0.006 * 0.04
    _, clean = calibrate(tmp_path, capsys, HiddenServo("linear", 0.0, 900.0, 0.6, 4e-5), "clean")
    assert settling_s(out) > settling_s(clean)


def coupled_responses(exponent, lag, change=0.04, loss=0.03, noise=1e-3):
    """Return u and y of two coupled resonances whose stiffness falls by change times (A / 0.3)^exponent, with a lag."""
    levels, n, realisations = (0.1, 0.2, 0.3), 2048, 5
    random, responses = np.random.default_rng(11), {}
    line = np.arange(n // 2 + 1)
    modes = np.array([[1.0, 0.6], [-0.5, 1.0]])
    for level in levels:
        softening = change * (level / 0.3) ** exponent * (1.0 + 1j * lag)
        phases = np.exp(2j * np.pi * random.random((n // 2 + 1, 2, realisations)))
        u = np.fft.irfft(phases * ((line > 0) & (line < 900))[:, None, None], n, axis=0)
        u *= level / np.sqrt((u**2).mean(axis=(0, 1)))
        modal = 1.0 / (
            1.0 - softening - (line[:, None] / np.array([330.0, 470.0])) ** 2 + 1j * loss * line[:, None] / 400.0
        )
        response = np.einsum("oa,la,ia->loi", modes, modal, modes)
        y = np.fft.irfft(response @ np.fft.rfft(u, axis=0), n, axis=0)
        error = noise * random.standard_normal((*y.shape, 2))
        responses[f"u_{level}"], responses[f"y_{level}"] = np.stack([u, u], axis=3), y[..., None] + error
    return responses


@pytest.mark.parametrize(
    ("exponent", "lag", "name"),
    [(1.0, 0.42, "hysteresis"), (2.0, 0.0, "amplitude_dependent_stiffness"), (0.0, 0.0, "linear")],
)
def test_coupled_axes_are_told_apart_by_their_law_of_the_amplitude(tmp_path, capsys, exponent, lag, name):
    # The sign of a lag: a response Y/U with negative imaginary part follows late.
    np.savez(tmp_path / "r.npz", **coupled_responses(exponent, -lag))
    assert run(["calibrate", "servo", f"{tmp_path}/r.npz", "--sample-rate", "5000", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["probability"][name] > 0.95
    if name == "linear":
        return
    for level, error in report["error"]["model"].items():
        assert error < 0.3 * report["error"]["linear"][level]


def held_responses(change, hz, damping, rate_hz=10_000.0, n=2048):
    """Return u and y of two coupled mirrors behind a converter that holds, as exact responses of discrete modes.

    Their stiffness falls by change times A / 0.3, with the lag of Rayleigh's hysteresis.
    """
    random, responses = np.random.default_rng(12), {"angle_per_output": np.array([[1.0, -0.2], [0.0, 1.0]])}
    line, shapes = np.arange(n // 2 + 1), np.array([[1.0, 0.3], [0.0, 1.0]])
    z = np.exp(2j * np.pi * line / n)[:, None]
    for level in (0.1, 0.2, 0.3):
        softening = change * (level / 0.3) * (1.0 - 0.42j)
        omega = 2.0 * np.pi * np.array(hz) * np.sqrt(1.0 - softening)
        pole = np.exp(omega * (-damping + 1j * np.sqrt(1.0 - damping**2)) / rate_hz)
        # A step ends as 1 + 2 Re(ring exp(λ t)), at rest at its beginning.
        ring = -0.5 * (1.0 - 1j * damping / np.sqrt(1.0 - damping**2))
        first, second = ring * (pole - 1.0) / (z - pole), np.conj(ring) * (np.conj(pole) - 1.0) / (z - np.conj(pole))
        modal = (first + second) / (1.0 - softening)
        response = np.einsum("oa,la,ai->loi", shapes, modal, np.linalg.inv(shapes))
        phases = np.exp(2j * np.pi * random.random((n // 2 + 1, 2, 5)))
        u = np.fft.irfft(phases * ((line > 0) & (line < 900))[:, None, None], n, axis=0)
        u *= level / np.sqrt((u**2).mean(axis=(0, 1)))
        y = np.fft.irfft(response @ np.fft.rfft(u, axis=0), n, axis=0)[..., None]
        responses[f"u_{level}"] = np.stack([u, u], axis=3)
        responses[f"y_{level}"] = y + 1e-5 * random.standard_normal((*y.shape[:3], 2))
    return responses


@pytest.mark.parametrize(("change", "refused"), [(0.002, False), (0.04, True)])
def test_plans_load_coupled_mirrors_with_the_error_that_stays(tmp_path, capsys, frames, change, refused):
    np.savez(tmp_path / "r.npz", **held_responses(change, (900.0, 1300.0), 0.25))
    out = str(tmp_path / "mirrors.toml")
    assert run(["calibrate", "servo", f"{tmp_path}/r.npz", "--sample-rate", "10000", "--out", out, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    # The end of a move changes by a third of the change of stiffness on either side of the middle amplitude.
    share = np.array(found["effect"]["error_rad"]) / max(move_sizes_rad(load_config(), 0))
    assert np.all((share > 0.3 * change) & (share < 3.0 * change))
    assert run(["plan", str(frames), "--json", "--mirrors", out]) == (2 if refused else 0)
    answer = capsys.readouterr()
    if refused:
        assert "of mirror x leaves an error that no settling time removes" in answer.err
        return
    assert found["effect"]["name"] == ["hysteresis"] * 2
    assert run(["plan", str(frames), "--json"]) == 0
    assert json.loads(answer.out)["settling_s"] > json.loads(capsys.readouterr().out)["settling_s"]


def test_coupled_mirrors_that_ring_longer_than_a_file_can_state_are_refused(tmp_path, capsys):
    np.savez(tmp_path / "r.npz", **held_responses(0.002, (900.0, 1300.0), 0.01))
    out = tmp_path / "mirrors.toml"
    assert run(["calibrate", "servo", f"{tmp_path}/r.npz", "--sample-rate", "10000", "--out", str(out)]) == 2
    assert "the slowest in a file" in capsys.readouterr().err
    assert not out.exists()


def test_decoupled_axes_of_an_npz_are_judged_one_by_one(tmp_path, capsys):
    random, arrays = np.random.default_rng(5), {}
    servos = HiddenServo("Duffing", 0.1, 300.0, 0.5, 0.0), HiddenServo("linear", 0.0, 400.0, 0.5, 0.0)
    n, rate_hz = 1024, 8000.0
    for level in (0.2, 0.5, 1.0):
        line = np.arange(1, 100)
        u = np.zeros((n, 2, 3, 2))
        for realisation in range(3):
            for axis in range(2):
                spectrum = np.zeros(n // 2 + 1, complex)
                spectrum[line] = np.exp(2j * np.pi * random.random(len(line)))
                period = np.fft.irfft(spectrum, n)
                u[:, axis, realisation] = (level * period / period.std())[:, None]
        y = np.zeros_like(u)
        for axis, servo in enumerate(servos):
            for realisation in range(3):
                steady = servo.follow(np.tile(u[:, axis, realisation, 0], 5), rate_hz, 1.0)[3 * n :]
                y[:, axis, realisation] = steady.reshape(2, n).T + 1e-3 * random.standard_normal((n, 2))
        arrays[f"u_{level}"], arrays[f"y_{level}"] = u, y
    np.savez(tmp_path / "r.npz", **arrays)
    assert run(["calibrate", "servo", f"{tmp_path}/r.npz", "--sample-rate", f"{rate_hz}", "--json"]) == 0
    first, second = (each["linearity"]["probability"] for each in json.loads(capsys.readouterr().out)["axes"])
    assert first["amplitude_dependent_stiffness"] > 0.95
    assert second["linear"] > 0.95


@pytest.mark.skipif("STEERING_MIRROR_NPZ" not in os.environ, reason="STEERING_MIRROR_NPZ does not name the data")
def test_one_model_of_a_measured_piezo_mirror_predicts_an_amplitude_left_out(capsys):
    path = os.environ["STEERING_MIRROR_NPZ"]
    assert run(["calibrate", "servo", path, "--sample-rate", "6400", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["probability"]["hysteresis"] > 0.95
    assert report["number_count"] <= 40
    # One response per amplitude leaves 0.064, 0.106 and 0.146 µm; one linear response, without 0.2 V, 0.238 µm there.
    within = 1.2 * np.array([0.064, 0.106, 0.146])
    assert np.all(np.array(list(report["error"]["model"].values())) <= within)
    assert list(report["error"]["fitted_without"].values())[1] <= 0.15


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "--sample-rate: missing"),
        (("--sample-rate", "5000", "--out", "m.toml"), "angle_per_output: missing"),
    ],
)
def test_what_an_npz_lacks_is_one_line(tmp_path, capsys, arguments, words):
    np.savez(tmp_path / "r.npz", u_1=np.zeros((64, 1, 2, 2)), y_1=np.zeros((64, 1, 2, 2)))
    assert run(["calibrate", "servo", f"{tmp_path}/r.npz", *arguments]) == 2
    assert words in capsys.readouterr().err


def rehearse(display):
    """Return what a scope would record of `calibrate steps` on a display's configured mirrors."""
    rig, runs = ExclusiveRig(display, lambda *_: None), []

    def record(run, commands):
        t_s, x_rad, y_rad = measure_position_outputs(display.config, commands, commands[-1, 0] + 0.015, len(runs)).T
        signals = {
            f"mirror_{axis}_rad": Signal(0, t_s.copy(), each.copy())
            for axis, each in zip("xy", (x_rad, y_rad), strict=True)
        }
        runs.append(Run(run.name, 295.0, np.zeros((0, 4)), signals, {}, commands))

    with rig.armed() as held:
        play_step_runs(plan_step_runs(held, 24), held, 0.1, record)
    return Measurement(tuple(runs))


def name_effect(measurement, axis):
    servo = identify("r", extract_trace("r", measurement, axis), 100.0).servo
    return find_effect(extract_records("r", measurement, axis), 2.0 * np.pi * servo.frequency, servo)


@pytest.mark.parametrize(
    "name", [pytest.param(each, marks=[] if each == "display-16" else pytest.mark.slow) for each in sorted(DISPLAYS)]
)
def test_a_rehearsal_names_the_slew_limit_of_the_configured_servo_and_nothing_else(name):
    measurement = rehearse(DISPLAYS[name])
    assert [each.held_out for each in extract_records("r", measurement, 0)] == [False, True] * 3
    for axis in range(1 if name == "display-16" else 2):
        found = name_effect(measurement, axis)
        assert (found.claim.verdict, found.effect) == ("cause", "slew_limit")
        assert found.fits["slew_limit"].misfit2 < 1.1


@pytest.mark.parametrize("seed", [902, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (900, 901, 903, 904))])
def test_steps_of_a_linear_servo_name_no_effect(seed):
    random = np.random.default_rng(seed)
    servos = [replace(LinearServo.sample(random), slew=1e7) for _ in range(2)]
    rate_hz, noise = (float(np.exp(random.uniform(*np.log(ends)))) for ends in ((1e4, 1e5), (1e-3, 1e-2)))
    measurement = step_recording(servos, random, rate_hz, noise)
    found = name_effect(measurement, 0)
    assert found.claim.verdict == "none"
    # Rounding errors of a response that the free one contains must not be scaled up.
    assert found.fits["linear"].misfit2 < 1.1


def test_a_whole_amplitude_is_held_out_where_each_was_recorded_once():
    random = np.random.default_rng(1)
    servo = LinearServo(900.0, 0.6, 4e-5, 90.0)
    once = extract_records("r", step_recording((servo, servo), random), 0)
    assert [each.held_out for each in once] == [False, True, False]
    assert len({each.level for each in once}) == 3
    twice = recording((HiddenServo("linear", 0.0, 900.0, 0.6, 0.0),) * 2, random, count=512)
    assert [each.held_out for each in extract_records("r", twice, 0)] == [False, True] * 3
