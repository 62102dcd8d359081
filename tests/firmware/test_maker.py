"""The way from a new configuration to a Pico in the emulator that plays text, by the documented commands alone."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from emulated_pico import MODULES, require_emulator

from optodrive.device.config_file import load_config
from optodrive.planning.display_model import DisplayModel
from rig import wait_for

COMMAND = [sys.executable, "-m", "optodrive.cli.main"]
NEW = ["--rows", "6", "--columns", "14", "--pitch-mm", "4", "--power-w", "2.45", "--lens-mm", "220"]
FULL_DUTY = 2500


@pytest.fixture
def maker(tmp_path):
    """Return a folder in which commands run, and the processes that go on."""
    running = []

    def start(*arguments, **environment):
        with (tmp_path / f"{arguments[0]}.out").open("w") as output:
            process = subprocess.Popen(
                [*COMMAND, *arguments], cwd=tmp_path, env=os.environ | environment, stdout=output, stderr=output
            )
        running.append(process)
        return process

    def run(*arguments, **environment):
        done = subprocess.run(
            [*COMMAND, *arguments], cwd=tmp_path, env=os.environ | environment, capture_output=True, text=True
        )
        return done.returncode, done.stdout + done.stderr

    yield start, run
    for process in reversed(running):
        process.terminate()
        process.wait()


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_text_is_played_on_the_image_of_a_new_configuration(maker, tmp_path):
    """The chip's time is a tenth of the computer's: most of some minutes is waiting."""
    require_emulator()
    start, run = maker
    port = tmp_path / "pico"
    assert run("config", "new", "my.toml", *NEW, "--port", str(port))[0] == 0
    with (tmp_path / "my.toml").open("a") as file:
        file.write("\n[daemon]\nport = 0\n")
    assert run("board", "build", "my.uf2", "--config", "my.toml")[0] == 0
    start("board", "emulate", "my.uf2", "--port", str(port), "--log", "pins.jsonl", "--modules", str(MODULES))
    said = tmp_path / "board.out"
    wait_for(lambda: "export " in said.read_text(), "the board's port")
    exported = said.read_text().split("export ")[1].split(";")[0].split()
    environment = dict(each.split("=", 1) for each in exported)
    start("serve", "--config", "my.toml", **environment)
    wait_for(lambda: "DISARMED" in (tmp_path / "serve.out").read_text(), "the daemon and its board")
    url = ("--url", re.search(r"http://[\d.:]+", (tmp_path / "serve.out").read_text())[0])
    assert run("arm", *url, **environment)[0] == 0

    def read_pins(kind):
        lines = (tmp_path / "pins.jsonl").read_text().splitlines()
        return [each for each in map(json.loads, lines) if each["event"] == kind]

    # A display without a record counts as hot: the first text gets less light, or none.
    plays = []
    while len(read_pins("gate")) < 20:
        plays.append(run("play", "text", "text=a", *url, **environment)[1])
        assert "done" in plays[-1], plays
    gate, mirrors = read_pins("gate"), read_pins("mirrors")
    assert [each["on"] for each in gate] == [True, False] * (len(gate) // 2)
    assert all(0 < each["compare"] <= FULL_DUTY for each in gate if each["on"])
    display = DisplayModel.from_config(load_config(tmp_path / "my.toml"))
    x_rad, y_rad = display.scan_head.field.angles_rad(display.layout.x_m, display.layout.y_m)
    codes = np.rint(np.column_stack([x_rad, y_rad]) / display.config.scanner.rad_per_code) + 32768
    drawn = set()
    for edge in gate[::2]:
        place = [each for each in mirrors if each["t_us"] < edge["t_us"]][-1]
        distance = np.abs(codes - (place["x"], place["y"])).max(axis=1)
        assert distance.min() <= 1.0
        drawn.add(int(distance.argmin()))
    # The letter a is one dot of six.
    assert len(drawn) == 1
    assert run("stop", *url, **environment)[0] == 0
    assert not read_pins("gate")[-1]["on"]
