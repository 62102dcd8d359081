"""Folders with the files that the examples of a page need, and scripts that run the examples in them."""

import json
import os
import shutil
import subprocess
import sys
import wave
from pathlib import Path

import h5py
import numpy as np
from pages import list_examples
from shown_output import find_difference

from display_lab import display_lab
from foreign_systems import motor_record
from hidden_field import CONFIG, grid_codes, measure_spots
from hidden_servo import HiddenServo
from hidden_servo import recording as record_servos
from labs import lab, lab_with_slack
from optodrive.device.config_file import list_shipped_configs, locate_shipped
from optodrive.lab.calibration.spots import write_spots
from optodrive.lab.recording.writer import write_recording
from optodrive.link.simulator.true_geometry import GroundTruthGeometry
from rig import config_text

PROGRAMS = Path(sys.executable).parent
FRAMES = {"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"17": 50, "18": 120.5}}]}
WAIT = "for _ in $(seq 300); do curl -fs http://127.0.0.1:8450/v1/health > /dev/null && break; sleep 0.1; done"
HEAD = """set -euo pipefail
daemon=
end() {
  [ -z "$daemon" ] || { kill "$daemon"; wait "$daemon"; }
  daemon=
}"""
READ_STATUS = "echo $?"
SANDBOX = ("--dev-bind", "/", "/", "--unshare-net", "--unshare-pid", "--proc", "/proc", "--die-with-parent")


def find_obstacle():
    """Return why examples cannot be run with a network of their own, None if they can."""
    for program in ("bwrap", "curl", "openssl"):
        if shutil.which(program) is None:
            return f"{program} is missing"
    tried = subprocess.run(["bwrap", *SANDBOX, "true"], capture_output=True, text=True)
    return f"bubblewrap cannot create a network: {tried.stderr.strip()}" if tried.returncode else None


def write_script(examples):
    """Return the shell script of examples: a daemon runs in the background until the next one, or the end.

    An example that talks to a daemon gets one, with an armed board, if no example has started one.
    """
    lines, is_served = [HEAD], False
    for number, example in enumerate(examples):
        reads_status, has_status = example.text == READ_STATUS, is_followed_by_status(examples, number)
        if not reads_status:
            lines.append(f"echo {example.page}:{example.line} >&2")
        talks = example.text.startswith("curl") or "Display(" in example.text
        if talks and not is_served:
            lines += [*serve("optodrive serve"), "optodrive arm"]
        is_served = is_served or talks
        if example.is_python:
            lines += [f"python - <<'END_OF_EXAMPLE_{number}'", example.text, f"END_OF_EXAMPLE_{number}"]
        elif "optodrive serve" in example.text:
            lines += serve(example.text)
            is_served = True
            if "--record-session" in example.text:  # an empty session cannot be merged
                lines += ["optodrive arm", "optodrive play pixel pixel=200 seconds=0.1", "end"]
        elif example.output is not None:
            lines += ["set +e"] if has_status else []
            lines.append(f"{{ {example.text}; }} > {name_output(number)} 2>&1")
            lines += ["set -e"] if reads_status else []
        else:
            lines.append(example.text)
    return "\n".join([*lines, "end", ""])


def name_output(number):
    """Return the file with the output of an example."""
    return f"output-{number}.txt"


def is_followed_by_status(examples, number):
    """Return whether the page shows the exit status of an example, which may then fail."""
    return number + 1 < len(examples) and examples[number + 1].text == READ_STATUS


def compare_outputs(examples, folder):
    """Return how the outputs of examples that ran in a folder differ from those that their pages show."""
    differences = []
    for number, example in enumerate(examples):
        if example.output is not None:
            difference = find_difference(example.output, (folder / name_output(number)).read_text())
            differences += [f"{example.page}:{example.line}: {example.text}\n{difference}"] if difference else []
    return "\n\n".join(differences)


def serve(command):
    """Return the lines that start a daemon in the background and wait until it answers."""
    return ["end", f"{command} > serve.log 2>&1 &", "daemon=$!", WAIT]


def write_patient_configs(folder):
    """Write the shipped configurations with a lease that a stalled computer outlasts. Return the folder."""
    shutil.copytree(locate_shipped(), folder)
    for name in list_shipped_configs():
        (folder / f"{name}.toml").write_text(config_text(name=name))
    return folder


def run_script(script, folder):
    """Run a script in a folder with a network, a home and a runtime folder of its own. Return its output."""
    (folder / "script.sh").write_text(script)
    configs = write_patient_configs(folder / "configs")
    (folder / "runtime").mkdir(mode=0o700)
    ended = subprocess.run(
        ["bwrap", *SANDBOX, "--bind", configs, locate_shipped(), "--chdir", folder, "bash", "script.sh"],
        env={
            "PATH": f"{PROGRAMS}:/usr/bin:/bin",
            "HOME": str(folder),
            "XDG_CACHE_HOME": os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache"),
            "XDG_RUNTIME_DIR": str(folder / "runtime"),
            "PYTHONPATH": str(Path(__file__).parents[2]),
        },
        capture_output=True,
        text=True,
    )
    daemon = folder / "serve.log"
    shown = ended.stderr + (daemon.read_text() if daemon.exists() else "")
    printed = "".join(path.read_text() for path in sorted(folder.glob("output-*.txt")))
    assert ended.returncode == 0, shown + printed
    assert "Traceback" not in shown + printed, shown + printed
    return ended.stdout


def write_frames(folder):
    """Write frames.json, and late.json, which does not fit."""
    (folder / "frames.json").write_text(json.dumps(FRAMES))
    late = {"id": "late", "show_at_s": 0.0, "duration_s": 0.1, "target_um": {str(pixel): 100 for pixel in range(40)}}
    (folder / "late.json").write_text(json.dumps({"frames": [late]}))


def write_checkout(folder):
    """Make the programs of the environment available as those of a checkout, and as those of a new environment."""
    for name in (".venv", "display"):
        (folder / name).symlink_to(sys.prefix)
    write_frames(folder)


def write_stimuli(folder):
    """Write what the examples of patterns play, beside a checkout."""
    write_checkout(folder)
    (folder / "page.brf").write_text(",HELLO _W4")
    (folder / "graph.svg").write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 20 20" fill="none" stroke="black" '
        'stroke-width=".2"><path class="axes" d="M0 10H20M10 0V20"/>'
        '<path d="M1 18C7 18 13 2 19 2"/></svg>'
    )
    tap = {"EventType": "HapticTransient", "EventParameters": [{"ParameterID": "HapticIntensity", "ParameterValue": 1}]}
    (folder / "knock.ahap").write_text(json.dumps({"Version": 1.0, "Pattern": [{"Event": tap}]}))
    with wave.open(str(folder / "voice.wav"), "wb") as file:
        file.setparams((1, 2, 8000, 0, "NONE", ""))
        file.writeframes((np.sin(np.arange(1600)) * 9000).astype("<i2").tobytes())


def write_recordings(folder):
    """Write recordings of a pixel whose membrane creeps, and a configuration."""
    write_frames(folder)
    creep = {"membrane_creep": {"share": 0.12, "time": 0.1, "spread": 0.0}}
    for seed, name in enumerate(("recording", "monday", "tuesday")):
        write_recording(folder / f"{name}.h5", lab(seed, creep))
    shutil.copy(locate_shipped("display-437.toml"), folder / "my-display.toml")
    shutil.copy(folder / "recording.h5", folder / "swapped.h5")
    with h5py.File(folder / "swapped.h5", "r+") as file:
        times_s = file["runs/run003/displacement_m/t_s"]
        times_s[81] = times_s[80] - 5e-4


def write_motor(folder):
    """Write the model of a motor as its page prints it, and a record of one with dry friction."""
    (model,) = (item.text for item in list_examples() if item.is_python and "OdeModel(" in item.text)
    (folder / "motor.py").write_text(model)
    record = motor_record(1, 12.0)
    columns = np.column_stack([record.t_s, record.inputs, record.outputs])
    rows = "\n".join(",".join(map(repr, row)) for row in columns.tolist())
    (folder / "monday.csv").write_text(f"t_s,voltage,encoder\n{rows}\n")


def write_slack(folder):
    """Write the recording of a membrane that no known cause explains."""
    write_recording(folder / "recording.h5", lab_with_slack(32))


def write_film(folder):
    """Write recordings of several pixels, under the names that the pages use."""
    film = display_lab({pixel: {} for pixel in range(5)}, groups=("weak", "strong"))
    for name in ("film", "recording", "display"):
        write_recording(folder / f"{name}.h5", film)


def write_measured(folder):
    """Write a recording without pulses for the first run of a session."""
    times_s = np.arange(0.0, 1.0, 1e-3)
    signal = folder / "measured" / "run1"
    signal.mkdir(parents=True)
    (folder / "measured" / "recording.toml").write_text(
        'format = "optotactile-recording"\nversion = 1\ninstrument_notes = "a vibrometer"\n'
        "[runs.run1]\nambient_K = 295.0\n[runs.run1.displacement_m]\npixel = 200\nsigma = 2e-7\n"
    )
    (signal / "pulses.csv").write_text("start_s,width_s,power_W,pixel\n")
    rows = "\n".join(f"{time_s:.4f},{1e-7 * np.sin(50 * time_s):.3e}" for time_s in times_s)
    (signal / "displacement_m.csv").write_text(f"t_s,value\n{rows}\n")


def write_calibration(folder):
    """Write spots of a hidden geometry, points, a recording of hidden mirrors, and frames."""
    write_frames(folder)
    random = np.random.default_rng(1)
    truth = GroundTruthGeometry.sample(1, CONFIG)
    write_spots(
        folder / "spots.csv", measure_spots(truth, grid_codes(17), random, outlier_fraction=0.035)[0], CONFIG.name
    )
    (folder / "points.csv").write_text("x_m,y_m\n0.0,0.0\n0.01,-0.02\n")
    servo = HiddenServo(900.0, 0.7, 30e-6, 60.0)
    write_recording(folder / "recording.h5", record_servos((servo, servo), random))
