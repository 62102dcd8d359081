"""Diagnosis of a whole display pixel by pixel: execution of the tasks, the task, its answer, and groups of answers.

Tasks run on worker processes of this computer or on a Dask cluster. A task whose worker was lost, for it ended or a
signal has stopped it, runs again alone after all others. If that costs another worker, the task is at fault, as one
that needs more memory than there is.
"""

import logging
import os
import re
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import wait
from typing import Any, TypeVar

import numpy as np

from optodrive.core.errors import InputError, OptodriveError
from optodrive.core.extras import import_extra
from optodrive.core.types.discrepancy import Discrepancy
from optodrive.core.types.measurements import Measurement
from optodrive.core.worker_process import LOOK_PERIOD_S, WorkerLostError, WorkerProcess
from optodrive.device.config import Config
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.noise_model import ColouredNoise, whiten
from optodrive.lab.diagnosis.nominal_fit import DEFAULT_PARAMETER_SET, build_prior
from optodrive.physics.parameters import load_parameters
from optodrive.physics.pixel_ode import ActiveTerms, PixelExperiment, simulate_signals

Task = TypeVar("Task")
Result = TypeVar("Result")

SCHEDULER_TIMEOUT_S = 3.0
"""Time within which a scheduler must answer."""
CHECK_PERIOD_S, CHECK_TIMEOUT_S, IMPORT_TIMEOUT_S = 0.5, 2.5, 30.0
"""Interval of the questions whether a scheduler is alive, and time for its answer: the first one comes after it has
imported what the tasks need."""
POLL_S = 0.02
ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
CLOSE_TIMEOUT_S = 0.5
WORKER_TIMEOUT_S = 30.0
"""Time within which a scheduler must have a worker."""
LOST = "the worker died each time, the last time with no other task running: out of memory?"
"""Error of a task whose worker was lost."""


def run_tasks(
    function: Callable[[Task], Result], tasks: list[Task], workers: int | None = None, address: str | None = None
) -> Iterator[tuple[Task, Result | None, str]]:
    """Yield each task with its result, or with a one-line error, in the order of completion.

    workers: local processes, by default one per core; address: of a Dask scheduler, which has its own workers. Raises
    InputError if the address is invalid or no scheduler with a worker answers there, OptodriveError if it is lost.
    """
    with ExitStack() as stack:
        if address is None:
            run = partial(_run_on_processes, workers or len(os.sched_getaffinity(0)))
        else:
            run = partial(_run_on_dask, _connect(address, stack))
        # Alone and last: a task that costs its worker must not take the others' time or memory.
        lost = []
        for task, result, error in run(function, tasks):
            if error == LOST:
                lost.append(task)
            else:
                yield task, result, error
        for task in lost:
            yield from run(function, [task])


def _run_on_processes(
    count: int, function: Callable[[Task], Result], tasks: list[Task]
) -> Iterator[tuple[Task, Result | None, str]]:
    """Run tasks on a number of processes, each of which is replaced when it is lost."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one thread per process; this one has its threads already
    waiting, running = deque(tasks), dict[WorkerProcess, Task]()
    with ExitStack() as stack:
        idle = [stack.enter_context(WorkerProcess()) for _ in range(min(count, len(tasks)))]
        while waiting or running:
            while waiting and idle:
                worker = idle.pop()
                running[worker] = waiting.popleft()
                with suppress(WorkerLostError):  # as its result tells
                    worker.submit(function, running[worker])
            wait([worker.fileno() for worker in running], LOOK_PERIOD_S)
            for worker, task in list(running.items()):
                result, error, free = None, "", worker
                try:
                    if not worker.is_ready():
                        continue
                    result = worker.result()
                except WorkerLostError:
                    error, free = LOST, stack.enter_context(WorkerProcess())
                except OptodriveError as failure:
                    error = " ".join(str(failure).split())
                del running[worker]
                idle.append(free)
                yield task, result, error


def _connect(address: str, stack: ExitStack) -> Any:
    """Connect to a Dask scheduler. The stack disconnects."""
    distributed = import_extra("distributed", "dask")
    # The answers report a lost worker; Dask's own messages are a page long.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    expected = "a Dask scheduler's address, as tcp://host:8786"
    if not re.fullmatch(r"(tcp|tls)://([^\s/:\[\]]+|\[[0-9a-fA-F:]+\]):[0-9]{1,5}", address):
        raise InputError("--dask", address, expected)
    secured = distributed.Security().get_connection_args("client").get("ssl_context") is not None
    if address.startswith("tls:") and not secured:
        raise InputError("--dask", address, "certificates in Dask's configuration: distributed.comm.tls")
    # A client of which an interrupt leaves a part waits seconds for its own end, and says so.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING_SIGNALS)
    try:
        client = distributed.Client(address, timeout=SCHEDULER_TIMEOUT_S, set_as_default=False)
        stack.callback(client.close, timeout=CLOSE_TIMEOUT_S)
    except (OSError, ValueError, OverflowError):
        raise InputError("--dask", address, f"{expected}, that answers within {SCHEDULER_TIMEOUT_S:g} s") from None
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        client.wait_for_workers(1, timeout=WORKER_TIMEOUT_S)
    except TimeoutError:
        raise InputError("--dask", address, f"a scheduler with a worker within {WORKER_TIMEOUT_S:g} s") from None
    return client


def _run_on_dask(
    client: Any, function: Callable[[Task], Result], tasks: list[Task]
) -> Iterator[tuple[Task, Result | None, str]]:
    """Run tasks on a cluster. Raise OptodriveError if its scheduler is lost or suspended."""
    from distributed import KilledWorker, as_completed

    # pure=False: equal tasks are computed again, and no old result of this cluster is taken.
    futures = {client.submit(function, task, pure=False): task for task in tasks}
    completed, check_at_s = as_completed(list(futures), loop=client.loop), time.monotonic() + CHECK_PERIOD_S
    timeout_s = IMPORT_TIMEOUT_S
    try:
        while futures:
            while not completed.has_ready():
                time.sleep(POLL_S)
                # Futures of a suspended scheduler never end, and nothing tells so but a question.
                if time.monotonic() > check_at_s:
                    _check_scheduler(client, timeout_s)
                    timeout_s, check_at_s = CHECK_TIMEOUT_S, time.monotonic() + CHECK_PERIOD_S
            future = next(completed)
            error = future.exception()
            while future.status == "lost":  # a worker died with the result, which another computes again
                error = future.exception()
            if future.status == "cancelled":
                raise OptodriveError("the Dask scheduler was lost before all tasks ended; no file is written")
            task = futures.pop(future)
            if error is None:
                yield task, future.result(), ""
            else:
                text = " ".join(f"{type(error).__name__}: {error}".split())
                yield task, None, LOST if isinstance(error, KilledWorker) else text
    finally:
        if futures:
            # Also after an interrupt, else the cluster computes on for nobody.
            client.cancel(list(futures), force=True)


def _check_scheduler(client: Any, timeout_s: float) -> None:
    with suppress(OSError):  # a closed connection, of which the futures tell
        try:
            client.sync(client.scheduler.identity, callback_timeout=timeout_s)
        except TimeoutError:
            raise OptodriveError(
                f"the Dask scheduler did not answer within {timeout_s:g} s; no file is written"
            ) from None


MAX_JOINT_PIXELS = 4
"""Maximum number of pixels that are fitted together with one set of parameters; more are fitted separately."""


@dataclass(frozen=True)
class PixelTask:
    """Diagnosis of one pixel, for any worker.

    pixel: `MIRRORS` for the mirrors
    read: reads the pixel's runs
    use: kinds of findings of the inspection that leave nothing out
    """

    pixel: int
    read: Callable[[], Measurement]
    seed: int = 0
    config: Config | None = None
    use: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class PixelAnswer:
    """Diagnosis of one pixel without residual traces, or the error that prevented it.

    pixel: `MIRRORS` for the mirrors; width_m: if known
    """

    pixel: int
    discrepancy: Discrepancy | None
    error: str = ""
    width_m: float | None = None


@dataclass(frozen=True)
class PixelSpread:
    """Median and range of a value over pixels."""

    median: float
    low: float
    high: float
    unit: str

    @classmethod
    def from_values(cls, values: Iterable[float], unit: str = "1") -> "PixelSpread | None":
        """Return median and range of values, None without any."""
        found = list(values)
        return cls(float(np.median(found)), min(found), max(found), unit) if found else None


NOMINAL = ("none", "instrument", "undecided")
"""Verdicts with which a pixel keeps the nominal model."""


@dataclass(frozen=True, eq=False)
class PixelGroup:
    """Pixels with the same verdict and causes, each with its diagnosis."""

    verdict: str
    causes: tuple[str, ...]
    members: tuple[tuple[PixelAnswer, Discrepancy], ...]

    @property
    def parameters(self) -> dict[str, PixelSpread]:
        """Parameters of the named causes."""
        values: dict[tuple[str, str], list[float]] = {}
        for _, found in self.members if self.verdict == "cause" else ():
            for name, item in found.parameters.items():
                if "." in name:
                    values.setdefault((name, item.unit), []).append(item.value)
        spreads = {name: PixelSpread.from_values(numbers, unit) for (name, unit), numbers in values.items()}
        return {name: spread for name, spread in spreads.items() if spread is not None}

    @property
    def gain(self) -> PixelSpread | None:
        """Reduction of the error on held-out runs."""
        return PixelSpread.from_values(found.gain.reduction for _, found in self.members if found.gain is not None)

    @property
    def height_error(self) -> PixelSpread | None:
        """Rms error of planned heights, on held-out pushes where there are any."""
        errors = (found.height_error_held_out or found.height_error_fitted for _, found in self.members)
        return PixelSpread.from_values(error.extended_rms for error in errors if error is not None)

    @property
    def doubtful(self) -> list[int]:
        """Indices of the pixels at which the size of a named cause is not established, sorted."""
        return sorted(item.pixel for item, found in self.members if found.doubts)

    @property
    def pixels(self) -> list[int]:
        """Pixel indices, sorted."""
        return sorted(item.pixel for item, _ in self.members)


@dataclass(frozen=True, eq=False)
class DisplayAnswer:
    """Answers of all pixels, sorted by index, and of the mirrors where they were measured."""

    pixels: tuple[PixelAnswer, ...]
    mirrors: PixelAnswer | None
    elapsed_s: float

    @property
    def discrepancies(self) -> list[Discrepancy]:
        """Diagnoses of the pixels that have one."""
        return [item.discrepancy for item in self.pixels if item.discrepancy is not None]

    @property
    def failed(self) -> list[PixelAnswer]:
        """Answers that are errors."""
        return [item for item in self.pixels if item.discrepancy is None]

    def build_groups(self) -> list[PixelGroup]:
        """Return the pixels grouped by verdict and causes, largest group first."""
        by_causes: dict[tuple[str, tuple[str, ...]], list[tuple[PixelAnswer, Discrepancy]]] = {}
        for item in self.pixels:
            if (found := item.discrepancy) is not None:
                by_causes.setdefault((found.verdict, tuple(sorted(found.causes))), []).append((item, found))
        groups = [PixelGroup(*key, tuple(members)) for key, members in by_causes.items()]
        return sorted(groups, key=lambda item: (-len(item.members), item.verdict, item.causes))

    def build_model(self) -> tuple[Discrepancy | None, float | None, str]:
        """Return one pixel model of the display, its bridge width and its description, or None, None and the reason.

        The model has the medians over the largest group, provided that it holds more than half of all pixels and names
        a cause or none; all pixels of which no error was found are one group.
        """
        groups = self.build_groups()
        nominal = [item for group in groups if group.verdict in NOMINAL for item in group.members]
        members = max([nominal, *(list(group.members) for group in groups)], key=len)
        if 2 * len(members) <= len(self.pixels):
            return None, None, "no set of causes holds for most pixels"
        if (verdict := members[0][1].verdict) not in (*NOMINAL, "cause"):
            return None, None, f"most pixels are {verdict}"
        widths_m = {item.width_m for item, _ in members}
        if len(widths_m) > 1:
            return None, None, "the bridge widths of the pixels differ"
        discrepancies = [found for _, found in members if found.base]
        first = discrepancies[0]
        base = {name: _compute_median(item.base[name] for item in discrepancies) for name in first.base}
        terms = {
            key: {name: _compute_median(item.terms[key][name] for item in discrepancies) for name in values}
            for key, values in first.terms.items()
        }
        estimator = f"medians over {len(discrepancies)} of {len(self.pixels)} pixels"
        return replace(first, base=base, terms=terms), widths_m.pop(), estimator


def diagnose_pixel(task: PixelTask) -> PixelAnswer:
    """Run one task. Invalid data yield an answer with an error."""
    try:
        measurement = task.read()
        prior, width_m = build_prior(measurement, task.config)
        discrepancy = diagnose(measurement, task.seed, prior, use=task.use)
    except InputError as error:
        return PixelAnswer(task.pixel, None, str(error))
    bare = replace(discrepancy, residual_traces=(), held_out_traces=(), data_findings=discrepancy.omitted_data)
    return PixelAnswer(task.pixel, bare, width_m=width_m)


def compile_kernels() -> None:
    """Compile all kernels that a diagnosis needs, so that workers load them from the cache."""
    t_s = np.array([0.01, 0.02])
    experiment = PixelExperiment(np.array([[0.0, 0.01, 1.0, 0.0]]), 0, 293.15, (t_s, t_s, t_s))
    simulate_signals(experiment, load_parameters(DEFAULT_PARAMETER_SET).build_pixel(4e-4), ActiveTerms.from_values({}))
    whiten(t_s, np.ones((2, 1)), ColouredNoise(1.0, (1.0, 1.0), (0.01, 1.0)))


def _compute_median(values: Iterable[float]) -> float:
    return float(np.median(list(values)))
