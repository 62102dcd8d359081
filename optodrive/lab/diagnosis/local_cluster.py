"""A Dask cluster of local processes: `python -m optodrive.lab.diagnosis.local_cluster WORKERS FOLDER`.

It prints the address of its scheduler at once. It kills itself and its workers, all of one process group, when its
stdin ends, as it does with the process that started it.
"""

import logging
import os
import signal
import sys

import dask
from distributed import LocalCluster

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


def main(workers: int, folder: str) -> None:
    """Run a cluster of processes with one thread each on loopback, with its files in a folder, until stdin ends."""
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
