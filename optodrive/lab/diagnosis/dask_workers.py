"""Execution of many tasks on Dask, in local processes or on a cluster, with recovery from lost workers."""

import logging
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker
from tempfile import TemporaryDirectory
from typing import Any, TypeVar
from uuid import uuid4

from optodrive.core.errors import InputError, OptodriveError

Task = TypeVar("Task")
Result = TypeVar("Result")

SCHEDULER_TIMEOUT_S = 3.0
"""Time within which a scheduler must answer."""
WORKER_TIMEOUT_S = 30.0
"""Time within which a scheduler must have a worker."""
DASK_SETTINGS = {
    # A task whose worker was lost returns at once and runs again alone, which shows whether it is at fault.
    "distributed.scheduler.allowed-failures": 0,
    "distributed.scheduler.worker-saturation": 1.0,
    # Results are small: spilling frees no memory, and a paused worker would never resume.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "critical",
    "distributed.admin.system-monitor.gil.enabled": False,
}


@contextmanager
def open_client(
    address: str | None = None, workers: int | None = None, max_workers: int | None = None
) -> Iterator[Any]:
    """Yield a Dask client of the scheduler at an address, or of local processes, by default one per core.

    max_workers: upper limit of useful processes. Local processes listen on loopback only. Raises InputError if the
    address is invalid or no scheduler answers there.
    """
    try:
        import dask
        import distributed
    except ImportError:
        raise InputError("dask", None, "the extra: pip install 'optodrive[analysis]'", "missing_extra") from None
    # The answers report a lost worker; Dask's own messages are a page long.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        if address is not None:
            yield stack.enter_context(_connect(distributed, address))
            return
        stack.enter_context(dask.config.set(DASK_SETTINGS))
        count = workers or dask.system.CPU_COUNT
        scratch = stack.enter_context(TemporaryDirectory(prefix="optodrive-"))
        with _block_sigint():
            cluster = distributed.LocalCluster(
                n_workers=min(count, max_workers or count),
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address=None,
                worker_dashboard_address=None,
                local_directory=scratch,
                silence_logs=logging.CRITICAL,
            )
        stack.enter_context(cluster)
        yield stack.enter_context(distributed.Client(cluster, set_as_default=False))


@contextmanager
def _block_sigint() -> Iterator[None]:
    """Block SIGINT in processes started within the block; this process ends them."""
    resource_tracker.ensure_running()  # a later start would unblock SIGINT in the calling thread
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _connect(distributed: Any, address: str) -> Any:
    expected = "a Dask scheduler's address, as tcp://host:8786"
    if not re.fullmatch(r"(tcp|tls)://([^\s/:\[\]]+|\[[0-9a-fA-F:]+\]):[0-9]{1,5}", address):
        raise InputError("--dask", address, expected)
    secured = distributed.Security().get_connection_args("client").get("ssl_context") is not None
    if address.startswith("tls:") and not secured:
        raise InputError("--dask", address, "certificates in Dask's configuration: distributed.comm.tls")
    try:
        client = distributed.Client(address, timeout=SCHEDULER_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, OverflowError):
        raise InputError("--dask", address, f"{expected}, that answers within {SCHEDULER_TIMEOUT_S:g} s") from None
    try:
        client.wait_for_workers(1, timeout=WORKER_TIMEOUT_S)
    except TimeoutError:
        client.close()
        raise InputError("--dask", address, f"a scheduler with a worker within {WORKER_TIMEOUT_S:g} s") from None
    return client


def run_tasks(
    client: Any, function: Callable[[Task], Result], tasks: list[Task]
) -> Iterator[tuple[Task, Result | None, str]]:
    """Yield each task with its result, or with a one-line error, in the order of completion.

    A task whose worker was lost runs again alone after all others; if that costs another worker, the task is at fault.
    """
    from distributed import KilledWorker, as_completed

    run = uuid4().hex[:12]
    futures = {client.submit(function, task, key=f"{run}-{number}"): task for number, task in enumerate(tasks)}
    lost: list[Task] = []
    try:
        for future in as_completed(list(futures), loop=client.loop):
            task = futures.pop(future)
            error = _wait_for_error(future)
            if isinstance(error, KilledWorker):
                lost.append(task)
            else:
                yield (task, future.result(), "") if error is None else (task, None, _format_error(error))
        for number, task in enumerate(lost):
            future = client.submit(function, task, key=f"{run}-again-{number}")
            futures[future] = task
            error = _wait_for_error(future)
            del futures[future]
            if isinstance(error, KilledWorker):
                yield task, None, "the worker died each time, the last time with no other task running: out of memory?"
            else:
                yield (task, future.result(), "") if error is None else (task, None, _format_error(error))
    finally:
        if futures:
            client.cancel(list(futures), force=True)


def _wait_for_error(future: Any) -> Exception | None:
    """Return the exception of a future; raises OptodriveError if the scheduler is lost."""
    error: Exception | None = future.exception()
    if future.status in ("cancelled", "lost"):
        raise OptodriveError("the Dask scheduler was lost before all tasks ended; no file is written")
    return error


def _format_error(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
