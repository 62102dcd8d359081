"""Diagnosis of a recording of 100 pixels with 15 runs each on two worker processes, in one run."""

import resource
import tempfile
import time
from pathlib import Path

import measuring  # noqa: F401 - the folder of the tests

from display_lab import display_lab  # of the tests
from optodrive.lab.diagnosis.display_diagnosis import PixelTask, compile_kernels, diagnose_pixel, run_tasks
from optodrive.lab.recording import DisplayRuns, write_recording

PIXELS, WORKERS = 100, 2
HIDDEN_TERMS = (
    {"laser_droop": {"share": 0.1, "time": 0.05, "spread": 1.0}},
    {"bridge_conductivity": {"exponent": 0.4}},
    {"gas_leak": {"rate": 4.0}},
    {"heat_capacity": {"slope": 2e-3}},
    *({},) * 6,
)
"""Terms hidden on ten pixels after each other."""


def measure():
    hidden = {pixel: HIDDEN_TERMS[pixel % 10] for pixel in range(PIXELS)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "display.h5"
        write_recording(path, display_lab(hidden, seed=4000))
        file_mib = path.stat().st_size / 2**20
        compile_kernels()
        begin_s = time.monotonic()
        runs = DisplayRuns.open([path])
        opened_s = time.monotonic()
        tasks = [PixelTask(item.pixel, item.read) for item in runs.pixels]
        answers = {task.pixel: answer for task, answer, _ in run_tasks(diagnose_pixel, tasks, WORKERS)}
        end_s = time.monotonic()
        largest_mib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**10
    named = [answers[pixel].discrepancy.causes == tuple(terms) for pixel, terms in hidden.items()]
    busy_s = sum(answer.discrepancy.elapsed_s for answer in answers.values())
    yield "pixels, 15 runs per pixel", len(answers), "1"
    yield "size of the recording", file_mib, "MiB"
    yield "correct answers", sum(named), "1"
    yield "whole diagnosis", end_s - begin_s, "s"
    yield "part: opening the recording", opened_s - begin_s, "s"
    yield "per pixel, whole diagnosis", (end_s - begin_s) / len(answers), "s"
    yield "per pixel, on its worker", busy_s / len(answers), "s"
    yield "fraction of the workers' time in the diagnosis", busy_s / WORKERS / (end_s - opened_s), "1"
    yield "maximum memory of a worker", largest_mib, "MiB"
