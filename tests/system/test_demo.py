"""The demonstration of the README: a caller that comes before the announcement may arm at its first answer."""

import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from forked_process import Process
from rig import config_text

DEMO = Path(__file__).parents[2] / "scripts" / "demo.py"


def show(tmp_path, text):
    """Run the demo for one pattern on the display of a configuration's text. Return how it ended."""
    config = tmp_path / "config.toml"
    config.write_text(text)
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    return subprocess.run(
        [sys.executable, DEMO, "--seconds", "0.1", "--port", str(port), "--config", config],
        env=os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
    )


def test_every_planned_pulse_is_executed(tmp_path):
    """With a lease that a stalled computer outlasts, which the simulated board permits as the configuration's."""
    ended = show(tmp_path, config_text())
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "pulses planned 624, sent 624, executed 624" in ended.stdout
    assert "left out" not in ended.stdout
    [of_the_highest_target_um] = re.findall(r"([\d.]+) +│$", ended.stdout, re.M)
    [largest_um] = re.findall(r"largest membrane displacement ([\d.]+) µm, in showcase", ended.stdout)
    assert float(largest_um) > float(of_the_highest_target_um)  # by a train that states a power


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_demo_with_its_daemon(tmp_path, number):
    config = tmp_path / "config.toml"
    config.write_text(config_text())
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    command = [sys.executable, DEMO, "--port", str(port), "--config", config]
    environment = os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)}
    with Process(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as demo:
        said = ""
        while "arming" not in said:
            said += demo.stdout.readline()
        demo.send_signal(number)
        said += demo.stdout.read()  # to its end, which is that of the daemon, too
    assert "\nending\n" in said
    assert "Traceback" not in said
