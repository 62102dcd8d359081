"""The demonstration of the README: a caller that comes before the announcement may arm at its first answer."""

import os
import socket
import subprocess
import sys
from pathlib import Path

from rig import config_text

DEMO = Path(__file__).parents[2] / "scripts" / "demo.py"


def test_every_planned_pulse_is_executed(tmp_path):
    """With a lease that a stalled computer outlasts, which the simulated board permits as the configuration's."""
    config = tmp_path / "config.toml"
    config.write_text(config_text())
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    ended = subprocess.run(
        [sys.executable, DEMO, "--seconds", "0.1", "--port", str(port), "--config", config],
        env=os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "pulses planned 624, sent 624, executed 624" in ended.stdout
