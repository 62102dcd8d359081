"""Bench of a live diagnosis: an exclusive board and the sensor that records its pixels."""

from collections.abc import Callable
from datetime import UTC, datetime
from math import ceil
from typing import Any

import numpy as np

from optodrive.core.clock import Clock
from optodrive.core.errors import RefusedError
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.measurements import Run, Signal
from optodrive.lab.commissioning.armed_board import LOOP_STEP_S
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.lab.commissioning.pixel_reader import PixelReader
from optodrive.lab.commissioning.worker_process import WorkerProcess
from optodrive.lab.live_diagnosis.experiments import LEAD_S, Experiment
from optodrive.link.session.plan_job import PlanJob

SAMPLES_MAX = 1000
"""Samples per signal and run: two signals then take 2 s on the sensor's line."""
STEP_MIN_US = 200
REST_S = 2.0
"""Time from the end of a run to the next one, in which pixel and gas cool."""


class BoardBench:
    """Plays experiments on a connected board, which is armed from the first run to `disarm`."""

    def __init__(self, board: ExclusiveBoard, reader: PixelReader, worker: WorkerProcess, clock: Clock) -> None:
        self._board, self._reader, self._worker, self._clock = board, reader, worker, clock
        self._is_armed = False
        self._rested_s = 0.0

    def now_s(self) -> float:
        """Return the host's time, s."""
        return self._clock.now_s()

    def measure(self, experiment: Experiment) -> Run:
        """Play an experiment once it fits all caps, and return the sensor's recording of it.

        The run has the pulses that the board reported. Raises RefusedError if it reported fewer than planned.
        """
        board = self._board
        if not self._is_armed:
            board.arm()
            self._is_armed = True
        board.wait(max(0.0, self._rested_s - self.now_s()))
        step_us = max(STEP_MIN_US, ceil(experiment.span_s * 1e6 / SAMPLES_MAX))
        count = int(experiment.span_s * 1e6 / step_us)
        jobs: list[PlanJob] = []
        self._reader.begin(experiment.pixel, count, step_us)
        started = datetime.now(UTC).isoformat()
        board.play(experiment.plan, jobs.append)
        board.wait(experiment.span_s - float(experiment.pulses[-1, 0]))
        values = self._reader.read(count)
        self._rested_s = self.now_s() + REST_S
        scale = board.session.scale
        executed = jobs[-1].build_executed(experiment.plan, scale.full_power_w, scale.tick_s)
        if len(executed) != len(experiment.pulses):
            raise RefusedError(f"{experiment.name}: {len(executed)} of {len(experiment.pulses)} pulses were reported")
        start_s = LEAD_S + (executed.on_tick - executed.on_tick[0]) * scale.tick_s
        pulses = np.column_stack([start_s, executed.width_s, executed.power_w, executed.pixel])
        t_s: FloatArray = np.arange(count, dtype=np.float64) * (step_us * 1e-6)
        signals = {name: Signal(experiment.pixel, t_s, value) for name, value in values.items()}
        attributes: dict[str, str | float] = {
            "started_at": started,
            "bridge_width_m": board.config.display.bridge_width_m,
        }
        return Run(experiment.name, board.display.ambient_k, pulses, signals, attributes)

    def run_elsewhere(self, function: Callable[..., Any], *arguments: object) -> Any:
        """Run a function of a module in another process. An armed board keeps its lease meanwhile."""
        self._worker.submit(function, *arguments)
        while not self._worker.is_ready():
            if self._is_armed:
                self._board.step()
            else:
                self._board.session.step(LOOP_STEP_S, renew_lease=False)
        return self._worker.result()

    def disarm(self) -> None:
        """Disarm the board, which is armed again for the next run."""
        if self._is_armed:
            self._is_armed = False
            self._board.disarm()
