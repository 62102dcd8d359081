"""Start: the processor time of commands against that of an empty interpreter, and a first plan with an empty cache."""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from measuring import Row, measure_times_s, running_daemon

from rig import TOKEN  # of the tests

OPTODRIVE = str(Path(sys.executable).with_name("optodrive"))
FRAME = {"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"17": 50, "300": 60}}]}
COMMANDS = (("stop", None), ("status", 25), ("arm", 25), ("plan", 50), ("--help", None))
"""Commands, and the aimed ratio to an empty interpreter. `scripts/bench gate` times `stop` until STOP has left."""
OPTIONS = {"--runs": {"type": int, "default": 7, "help": "of each command"}}
FIRST_PLAN_S = 15.0


def read_children_cpu_s():
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def measure_cpu_ms(command, runs, prepare=lambda: None, **environment):
    """Return the processor time of each run of a command with its processes, ms. prepare: called before each."""

    def work():
        prepare()
        subprocess.run(command, check=True, capture_output=True, env={**os.environ, **environment})

    return [1e3 * value for value in measure_times_s(work, runs, read_children_cpu_s)]


def measure(runs):
    empty_ms = measure_cpu_ms([sys.executable, "-c", "pass"], runs)
    yield Row("`python -c pass`, CPU time", empty_ms)
    with running_daemon() as (_, daemon), tempfile.TemporaryDirectory() as folder:
        frames = Path(folder) / "frames.json"
        frames.write_text(json.dumps(FRAME))
        environment = {"OPTODRIVE_URL": daemon.url, "OPTODRIVE_TOKEN": TOKEN}
        for name, ratio in COMMANDS:
            command = [OPTODRIVE, name, *([str(frames)] if name == "plan" else [])]
            note = "" if ratio is None else f"aimed ratio {ratio}"
            values_ms = measure_cpu_ms(command, runs, lambda: daemon.call("POST", "/v1/disarm"), **environment)
            yield Row(f"`optodrive {name}`, CPU time", values_ms, "ms", None, "`python -c pass`", empty_ms, note)
    with tempfile.TemporaryDirectory() as folder:
        frames = Path(folder) / "frames.json"
        frames.write_text(json.dumps(FRAME))
        begin_s = time.monotonic()
        cpu_ms = measure_cpu_ms([OPTODRIVE, "plan", str(frames)], 1, NUMBA_CACHE_DIR=f"{folder}/cache")
        yield Row("a first plan with an empty cache, from start to end", time.monotonic() - begin_s, "s", FIRST_PLAN_S)
    yield Row("the same, CPU time of its two processes", 1e-3 * cpu_ms[0], "s")
