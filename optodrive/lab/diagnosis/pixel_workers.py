"""Execution of many tasks on worker processes of this computer or on a Dask cluster, with recovery from lost workers.

A task whose worker was lost, for it ended or a signal has stopped it, runs again alone after all others. If that costs
another worker, the task is at fault, as one that needs more memory than there is.
"""

import logging
import os
import re
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from functools import partial
from multiprocessing.connection import wait
from typing import Any, TypeVar

from optodrive.core.errors import InputError, OptodriveError
from optodrive.core.extras import import_extra
from optodrive.core.worker_process import LOOK_PERIOD_S, WorkerLostError, WorkerProcess

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
