"""The soak benchmark with few pulses: all arrive, and a missing one is reported."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
sys.path.append(str(SCRIPTS))

import bench_soak  # noqa: E402 - a script

LEAD_S = 2.0
"""Time in which the board receives all points before the first one, so that a stalled host leaves it none to lack."""


@pytest.mark.parametrize("pulses", [1000, pytest.param(3000, marks=pytest.mark.slow)])
def test_few_pulses_all_arrive(pulses):
    rows, failed = bench_soak.run_soak(pulses, LEAD_S)
    results = {name: value for name, value, _ in rows}
    assert results["pulses in the board's log"] == results["pulses reported to the session"] == pulses
    assert failed == []


@pytest.mark.parametrize("missing", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 7))])
def test_a_missing_pulse_is_detected(tmp_path, missing):
    log = tmp_path / "log"
    pulse = '{{"t_us": 0, "event": "pulse", "index": {0}, "x": 0, "y": 0, "duty": 1, "on_us": 0, "off_us": {1}}}\n'
    lines = [pulse.format(k, bench_soak.WIDTH_US + k % bench_soak.WIDTHS) for k in range(9)]
    for kept, out_of_order in ((lines, 0), (lines[:missing] + lines[missing + 1 :], 8 - missing)):
        log.write_text("".join(kept))
        command = [sys.executable, SCRIPTS / "bench_soak.py", log]
        output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        assert f'"pulses": {len(kept)}, "out_of_order": {out_of_order}, "holds": 0' in output
