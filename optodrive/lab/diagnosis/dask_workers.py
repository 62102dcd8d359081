"""Many tasks on Dask, in processes here or on a cluster. A lost worker costs the time of the tasks it had."""

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
"""A scheduler that has not answered by then is not there."""
WORKER_TIMEOUT_S = 30.0
"""A scheduler to which no worker has come by then has none."""
DASK_SETTINGS = {
    # A task whose worker was lost comes back at once, to be done alone: only so is it known whose fault it was.
    "distributed.scheduler.allowed-failures": 0,
    "distributed.scheduler.worker-saturation": 1.0,
    # Results are small: a worker short of memory has nothing to write to disk, and one that pauses never goes on.
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
    """A Dask client: of the scheduler at an address, or of as many processes here, by default one a core.

    most: so many processes can be used at all. They listen on loopback only. InputError where the address is none, or
    nothing answers there.
    """
    try:
        import dask
        import distributed
    except ImportError:
        raise InputError("dask", None, "the extra: pip install 'optodrive[analysis]'", "missing_extra") from None
    # What becomes of a lost worker is told by the answers; Dask would tell it in a page.
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
    """Processes begun here, now or later, do not hear Ctrl-C: ending them is this process's task."""
    resource_tracker.ensure_running()  # else it begins later, and opens the ears of the thread that begins it
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
        raise InputError(
            "--dask", address, f"{expected}, at which one answers within {SCHEDULER_TIMEOUT_S:g} s"
        ) from None
    try:
        client.wait_for_workers(1, timeout=WORKER_TIMEOUT_S)
    except TimeoutError:
        client.close()
        raise InputError("--dask", address, f"a scheduler with a worker within {WORKER_TIMEOUT_S:g} s") from None
    return client


def run_tasks(
    client: Any, function: Callable[[Task], Result], tasks: list[Task]
) -> Iterator[tuple[Task, Result | None, str]]:
    """Each task with its result, or with one line that says why it has none; in the order in which they end.

    A task that lost its worker is done again, by itself, when nothing else is left to do; if that costs another worker
    it is the task's own fault.
    """
    from distributed import KilledWorker, as_completed

    run = uuid4().hex[:12]
    futures = {client.submit(function, task, key=f"{run}-{place}"): task for place, task in enumerate(tasks)}
    lost: list[Task] = []
    try:
        for future in as_completed(list(futures), loop=client.loop):
            task = futures.pop(future)
            error = _wait_for_error(future)
            if isinstance(error, KilledWorker):
                lost.append(task)
            else:
                yield (task, future.result(), "") if error is None else (task, None, _format_error(error))
        for place, task in enumerate(lost):
            future = client.submit(function, task, key=f"{run}-again-{place}")
            futures[future] = task
            error = _wait_for_error(future)
            del futures[future]
            if isinstance(error, KilledWorker):
                yield task, None, "the worker died each time, the last time with nothing else to do: out of memory?"
            else:
                yield (task, future.result(), "") if error is None else (task, None, _format_error(error))
    finally:
        if futures:
            client.cancel(list(futures), force=True)


def _wait_for_error(future: Any) -> Exception | None:
    """How a future ended; OptodriveError where the scheduler is gone and it never will."""
    error: Exception | None = future.exception()
    if future.status in ("cancelled", "lost"):
        raise OptodriveError("the Dask scheduler was lost before all was done; nothing is written")
    return error


def _format_error(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
