"""README's chain: `simulate --truth` records, `diagnose` names the truth, with the noise of instruments and without.

Three recordings of one plan repeat each other; without a truth nothing is found (test_diagnose_command.py).
"""

import json

import pytest

from optodrive.cli.main import run
from optodrive.physics.terms import discover_terms
from truth_file import write_truth

MEASURED, BESIDE = 5, 6


def frame(at_s, duration_s, pixel, height_um):
    return {"show_at_s": at_s, "duration_s": duration_s, "target_um": {str(pixel): height_um}}


def train(pixel, start_s, duration_s, power_w, width_s=0.02, gap_s=0.04):
    drive = {"pulse_width_s": width_s, "gap_s": gap_s, "power_w": power_w}
    return {"pixel": pixel, "start_s": start_s, "duration_s": duration_s, **drive}


FRAMES = {
    "frames": [
        frame(0.05, 0.15, MEASURED, 60),
        frame(0.2, 0.2, MEASURED, 200),
        frame(0.4, 0.2, MEASURED, 350),
        frame(0.6, 0.2, BESIDE, 350),
    ],
    "trains": [
        train(MEASURED, 1.0, 1.6, 2.0),
        train(BESIDE, 2.9, 0.6, 2.0),
        train(MEASURED, 3.6, 0.049, 0.8, width_s=0.05),
        train(MEASURED, 3.8, 0.049, 1.6, width_s=0.05),
    ],
}
README_FRAMES = {"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"17": 50, "18": 120.5}}]}
NAMED = (
    *("ambient_drift", "bridge_conductivity", "clock_offset", "gas_leak", "heat_capacity", "laser_droop", "laser_lag"),
    *("laser_turn_on", "membrane_creep", "membrane_stiffening", "power_nonlinearity", "radiation", "sensor_lag"),
    *("smoothing", "time_rate", "wall_heating"),
)
"""Terms that this plan shows."""
NOT_SHOWN = {
    "absorber_ageing": "one simulated recording has one age: less absorption, as R and C",
    "beam_misalignment": "it shows between pixels, so two are recorded; one alone looks like a warm wall",
    "force_area": "a factor of the force, as φ",
    "high_pass": "a leak gives the same signal, so both are named",
    "gas_membrane": "no cause of its own: its stiffness is that of a membrane",
    "mirror_lag": "no mirror is recorded",
    "neighbour_crosstalk": "a neighbour's pulses heat by a few mK",
    "run_gain": "one gain of all runs, as R, C and κ together",
    "panel_heating": "three seconds of light heat a panel by mK",
    "sensor_scale": "R, C and κ together",
}
"""Terms that this plan does not show, or as another one; nothing false may be named beside them."""
REFUSED = ("lateral_conduction", "touch_surface")
"""Terms that only the limiter accounts for."""
FACTORS = {"clock_offset": 5.0}
"""Factors on the defaults: at a tenth of a sample, a late clock and a slow laser look the same."""
QUICK = ("sensor_lag", 1)
"""The laser's terms are named from recordings without noise."""
CASES = [
    pytest.param(key, noise, marks=() if (key, noise) == QUICK else pytest.mark.slow)
    for key in NAMED
    for noise in (0, 1)
]


def hide(key):
    """Return a term and those that it requires, with their defaults: term → parameter → SI value."""
    return {
        part: {
            item.name: MEASURED if item.name == "pixel" else item.default * FACTORS.get(part, 1.0)
            for item in discover_terms()[part].parameters
        }
        for part in (key, *discover_terms()[key].requires)
    }


def simulate(folder, key, noise, seed):
    """Record one simulation. Return the exit status and the file."""
    (folder / "frames.json").write_text(json.dumps(FRAMES))
    truth, out = write_truth(folder / "truth.toml", hide(key)), folder / f"recording{seed}.h5"
    options = (
        "--pixels",
        f"{MEASURED},{BESIDE}" if key == "beam_misalignment" else str(MEASURED),
        "--noise",
        str(noise),
        "--seed",
        str(seed),
    )
    arguments = ("simulate", folder / "frames.json", "--config", "display-16", "--truth", truth, "--out", out)
    return run([str(item) for item in (*arguments, *options)]), out


def find_causes(folder, capsys, key, noise):
    recordings = []
    for seed in range(3):
        status, out = simulate(folder, key, noise, seed)
        assert status == 0, capsys.readouterr().err
        recordings.append(str(out))
    capsys.readouterr()
    assert run(["diagnose", *recordings, "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    return answer["verdict"], answer["causes"]


@pytest.mark.timeout(600)
@pytest.mark.parametrize(("key", "noise"), CASES)
def test_the_truth_of_a_simulation_is_named(key, noise, tmp_path, capsys):
    assert find_causes(tmp_path, capsys, key, noise) == ("cause", [key])


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("noise", [0, 1])
@pytest.mark.parametrize("key", sorted(NOT_SHOWN))
def test_a_truth_that_the_plan_does_not_show_gives_no_false_name(key, noise, tmp_path, capsys):
    verdict, causes = find_causes(tmp_path, capsys, key, noise)
    imitates = {"gas_membrane": ["membrane_stiffening"], "high_pass": ["gas_leak", "high_pass"]}.get(key, [key])
    assert verdict == "none" or sorted(causes) == imitates, (verdict, causes)


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("laser_lag", {"time": 5e-4}),
        pytest.param("laser_droop", {"share": 0.2, "time": 5e-3, "spread": 1.5}, marks=pytest.mark.slow),
    ],
)
def test_a_laser_that_pulses_of_two_pixels_share_is_named(key, values, tmp_path, capsys):
    """README's frames light two pixels: the effect of the light of one on the laser shows on the other."""
    (tmp_path / "frames.json").write_text(json.dumps(README_FRAMES))
    truth, out = write_truth(tmp_path / "truth.toml", {key: values}), tmp_path / "recording.h5"
    arguments = ("simulate", tmp_path / "frames.json", "--truth", truth, "--out", out, "--repeats", 3, "--noise", 0)
    assert run([str(item) for item in arguments]) == 0, capsys.readouterr().err
    capsys.readouterr()
    assert run(["diagnose", str(out), "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["verdict"], answer["causes"]) == ("cause", [key])


@pytest.mark.timeout(600)
@pytest.mark.slow
@pytest.mark.parametrize("noise", [0, 1])
def test_a_small_panel_that_one_pixel_heats_for_seconds_is_named(noise, tmp_path, capsys):
    """The other pixel's light begins when the panel is warm. Its wall is not."""
    trains = [train(MEASURED, 0.0, 10.0, 2.0, gap_s=0.02), train(15, 10.5, 0.5, 2.0, gap_s=0.02)]
    (tmp_path / "frames.json").write_text(json.dumps({"trains": trains}))
    truth = write_truth(
        tmp_path / "truth.toml", {"panel_heating": {"resistance": 55.0, "capacity": 3.3, "share": 0.66}}
    )
    out = tmp_path / "recording.h5"
    arguments = ("simulate", tmp_path / "frames.json", "--config", "display-16", "--truth", truth, "--out", out)
    options = ("--repeats", 3, "--noise", noise, "--pixels", f"{MEASURED},15")
    assert run([str(item) for item in (*arguments, *options)]) in (0, 3), capsys.readouterr().err
    capsys.readouterr()
    assert run(["diagnose", str(out), "--json", "-"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["verdict"], answer["causes"]) == ("cause", ["panel_heating"])


@pytest.mark.parametrize("key", REFUSED)
def test_a_term_of_the_limiter_alone_is_refused_as_truth(key, tmp_path, capsys):
    assert simulate(tmp_path, key, 1, 0)[0] == 2
    assert key in capsys.readouterr().err


def test_every_shipped_term_is_tried():
    assert sorted((*NAMED, *NOT_SHOWN, *REFUSED)) == sorted(discover_terms())
