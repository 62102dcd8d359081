"""Execution of many tasks on Dask, in local processes or on a cluster, with recovery from lost workers.

The local cluster is a process of its own, `python -m optodrive.lab.diagnosis.dask_workers WORKERS FOLDER`. It prints
the address of its scheduler at once. It kills itself and its workers, all of one process group, when its stdin ends, as
it does with the process that started it.

A task whose worker was lost runs again alone after all others; if that costs another worker, the task is at fault.
"""

import logging
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Timer
from typing import Any, TypeVar

from optodrive.core.errors import InputError, OptodriveError
from optodrive.core.extras import import_extra

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
WORKER_TIMEOUT_S, LOCAL_TIMEOUT_S = 30.0, 120.0
"""Times within which a scheduler must have a worker, and a local one after its start."""
LOST_AGAIN = "the worker died each time, the last time with no other task running: out of memory?"
SETTINGS = {
    # A task whose worker was lost returns at once and runs again alone, which shows whether it is at fault.
    "distributed.scheduler.allowed-failures": 0,
    "distributed.scheduler.worker-saturation": 1.0,
    # A worker that a signal has stopped is replaced after this time, and its task runs again elsewhere.
    "distributed.scheduler.worker-ttl": "10s",
    # Results are small: spilling frees no memory, and a paused worker would never resume.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "critical",
    "distributed.admin.system-monitor.gil.enabled": False,
}
"""Dask's settings of the local cluster."""


@contextmanager
def open_client(
    address: str | None = None, workers: int | None = None, max_workers: int | None = None
) -> Iterator[Any]:
    """Yield a Dask client of the scheduler at an address, or of local processes, by default one per core.

    max_workers: upper limit of useful processes. Local processes listen on loopback only, and are killed at the end.
    Raises InputError if the address is invalid or no scheduler answers there, OptodriveError if no local process
    starts.
    """
    dask, distributed = import_extra("dask"), import_extra("distributed", "dask")
    # The answers report a lost worker; Dask's own messages are a page long.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        if address is not None:
            yield _connect(distributed, address, stack)
            return
        count = workers or dask.system.CPU_COUNT
        address = stack.enter_context(_start_local_cluster(min(count, max_workers or count)))
        try:
            client = _connect(distributed, address, stack, LOCAL_TIMEOUT_S)
        except InputError:
            raise OptodriveError("the worker processes of Dask did not start") from None
        yield client


@contextmanager
def _start_local_cluster(workers: int) -> Iterator[str]:
    """Yield the address of a cluster of local processes, which are killed at the end of the block."""
    with TemporaryDirectory(prefix="optodrive-") as folder, (Path(folder) / "errors").open("w+") as errors:
        cluster = subprocess.Popen(
            [sys.executable, "-P", "-m", "optodrive.lab.diagnosis.dask_workers", str(workers), folder],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,  # Ctrl-C ends this process, which kills the group
        )
        watch = Timer(LOCAL_TIMEOUT_S, cluster.kill)  # one that is suspended would say nothing
        watch.start()
        try:
            address = cluster.stdout.readline().strip() if cluster.stdout is not None else ""
            watch.cancel()
            if not address:
                errors.seek(0)
                reason = errors.read().strip().rpartition("\n")[2] or "their scheduler has ended"
                raise OptodriveError(f"the worker processes of Dask did not start: {reason}")
            yield address
        finally:
            watch.cancel()
            with suppress(ProcessLookupError):
                os.killpg(cluster.pid, signal.SIGKILL)
            cluster.communicate()


def _connect(distributed: Any, address: str, stack: ExitStack, worker_timeout_s: float = WORKER_TIMEOUT_S) -> Any:
    """Connect to a scheduler. The stack disconnects."""
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
        client.wait_for_workers(1, timeout=worker_timeout_s)
    except TimeoutError:
        raise InputError("--dask", address, f"a scheduler with a worker within {worker_timeout_s:g} s") from None
    return client


def run_tasks(
    client: Any, function: Callable[[Task], Result], tasks: list[Task]
) -> Iterator[tuple[Task, Result | None, str]]:
    """Yield each task with its result, or with a one-line error, in the order of completion."""
    from distributed import KilledWorker

    lost = []
    for task, result, error in _run_at_once(client, function, tasks):
        if isinstance(error, KilledWorker):
            lost.append(task)
        else:
            yield task, result, _format_error(error)
    for task in lost:
        for _, result, error in _run_at_once(client, function, [task]):
            yield task, result, LOST_AGAIN if isinstance(error, KilledWorker) else _format_error(error)


def _run_at_once(
    client: Any, function: Callable[[Task], Result], tasks: list[Task]
) -> Iterator[tuple[Task, Result | None, Exception | None]]:
    """Yield each task with its result or exception. Raise OptodriveError if the scheduler is lost or suspended."""
    from distributed import as_completed

    futures = {client.submit(function, task, pure=False): task for task in tasks}
    completed, check_at_s = as_completed(list(futures), loop=client.loop), time.monotonic() + CHECK_PERIOD_S
    timeout_s = IMPORT_TIMEOUT_S
    try:
        while futures:
            while not completed.has_ready():
                time.sleep(POLL_S)
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
            yield task, None if error is not None else future.result(), error
    finally:
        if futures:
            client.cancel(list(futures), force=True)


def _check_scheduler(client: Any, timeout_s: float) -> None:
    with suppress(OSError):  # a closed connection, of which the futures tell
        try:
            client.sync(client.scheduler.identity, callback_timeout=timeout_s)
        except TimeoutError:
            raise OptodriveError(
                f"the Dask scheduler did not answer within {timeout_s:g} s; no file is written"
            ) from None


def _format_error(error: Exception | None) -> str:
    return "" if error is None else " ".join(f"{type(error).__name__}: {error}".split())


def main(workers: int, folder: str) -> None:
    """Run a cluster of processes with one thread each on loopback, with its files in a folder, until stdin ends."""
    import dask
    from distributed import LocalCluster

    with dask.config.set(SETTINGS):
        cluster = LocalCluster(
            n_workers=0,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address=None,
            worker_dashboard_address=None,
            local_directory=folder,
            silence_logs=logging.CRITICAL,
        )
        cluster.scale(workers)  # without waiting: a worker that does not start is missing alone
        print(cluster.scheduler_address, flush=True)  # noqa: T201
        sys.stdin.read()
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
