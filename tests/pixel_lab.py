"""Calibration of a pixel map by commands: sweep, recordings of hidden pixels, map."""

import json
from pathlib import Path

import numpy as np

from optodrive.cli.main import run
from optodrive.device.config_file import load_config
from optodrive.device.pixel_map import load_pixel_map, replace_pixel_map
from optodrive.link.simulator.true_display import GroundTruthPixels

COOLDOWN_S = 5.0
"""Duration after which every pixel is cold again, s."""


def run_json(capsys, *arguments, status=0):
    """Run a command and return the JSON that it prints."""
    capsys.readouterr()
    assert run([str(each) for each in arguments]) == status
    return json.loads(capsys.readouterr().out)


def record_sweep(capsys, folder, display, seed, noise=1.0, aims=None):
    """Record a sweep over hidden pixels with the given aims or all. Return the files."""
    sweep = run_json(capsys, "calibrate", "pixels", "--sweep", folder / "sweep", "--config", display, "--json")
    recordings = []
    for k, aim in enumerate(sweep["aims"]):
        if aims is not None and aim["name"] not in aims:
            continue
        played, out = folder / "sweep" / aim["name"], folder / f"{aim['name']}.h5"
        answer = run_json(
            capsys,
            *("simulate", f"{played}.json", "--pixel-map", f"{played}.pixels.toml", "--config", display),
            *("--pixel-seed", seed, "--pixels", "all", "--post-pulse", 0.1, "--noise", noise, "--seed", 100 * seed + k),
            *("--out", out, "--json"),
        )
        assert not answer["summary"]["trimmed"]["pulses"]
        recordings.append(out)
    return recordings


def calibrate_map(capsys, folder, display, recordings):
    """Fit pixels.toml to recordings. Return its path and the statistics."""
    out = folder / "pixels.toml"
    answer = run_json(capsys, "calibrate", "pixels", "--config", display, "--out", out, "--json", *recordings)
    return out, answer


def measured_um(capsys, folder, display, seed, height_um, pixel_map=None):
    """Return the heights that the hidden pixels reach for one common target, µm, [p], and the answer."""
    count = len(GroundTruthPixels.sample(seed, load_config(display)).displacement_gain)
    frame = {
        "id": "all",
        "show_at_s": 0.0,
        "duration_s": COOLDOWN_S,
        "target_um": {str(k): height_um for k in range(count)},
    }
    frames = Path(folder / "frames.json")
    frames.write_text(json.dumps({"frames": [frame]}))
    more = () if pixel_map is None else ("--pixel-map", pixel_map)
    answer = run_json(
        capsys,
        *("simulate", frames, "--config", display, "--pixel-seed", seed, "--pixels", "all"),
        *("--post-pulse", 0.1, "--dt", 2e-4, "--json", *more),
    )
    return np.array([pixel["measured_max_um"] for pixel in answer["pixels"]]), answer


def map_errors(display, path, seed):
    """Return the errors of gains and offsets (m), and the errors over sigma: [3, p] each, NaN where unknown."""
    config = replace_pixel_map(load_config(display), path)
    known, truth = load_pixel_map(config), GroundTruthPixels.sample(seed, config)
    lives = ~known.dead
    off = np.where(
        lives,
        [known.gain - truth.displacement_gain, known.offset_x_m - truth.x_m, known.offset_y_m - truth.y_m],
        np.nan,
    )
    return off, off / [known.gain_sigma, known.offset_x_sigma_m, known.offset_y_sigma_m]
