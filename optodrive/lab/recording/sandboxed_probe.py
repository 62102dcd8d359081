"""Probe of an HDF5 file in a process with limited CPU time and memory.

The HDF5 library is not hardened against damaged files: a few changed bytes can make it crash or loop forever. A file
that a short-lived process has read from end to end is safe to be read in this process.
"""

import os
import resource
import subprocess
import sys
from contextlib import suppress
from math import ceil
from pathlib import Path
from time import process_time

from optodrive.core.errors import InputError, Unquoted
from optodrive.lab.recording.hdf5 import Hdf5Tree
from optodrive.lab.recording.storage import SIGNALS, TABLE_COLUMNS

CPU_LIMIT_S = 5
RUN_BYTES_PER_CPU_S = 20_000_000
"""Bytes per second of CPU time that a run may take beyond `CPU_LIMIT_S`; even compressed data is read faster."""
FILE_BYTES_PER_CPU_S = 200_000
"""Bytes per second of CPU time that the whole file may take beyond `CPU_LIMIT_S`; small runs take milliseconds."""
MEMORY_BYTES = 2**32
_PROGRAM = "from optodrive.lab.recording.sandboxed_probe import main; main()"
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
_probed_files: set[tuple[str, int, int, int, int]] = set()


def probe_in_sandbox(path: Path) -> None:
    """Read a file in a sandboxed process, once per file and process. Raise InputError if that process fails."""
    status = path.stat()
    identity = (str(path.resolve()), status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
    if identity in _probed_files:
        return
    run_limit_s = CPU_LIMIT_S + status.st_size // RUN_BYTES_PER_CPU_S
    file_limit_s = CPU_LIMIT_S + status.st_size // FILE_BYTES_PER_CPU_S
    try:
        process = subprocess.run(
            [sys.executable, "-P", "-c", _PROGRAM, str(path.absolute()), str(run_limit_s), str(file_limit_s)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(sys.path)},
            timeout=20 * file_limit_s,
            check=False,
        )
        has_succeeded = process.returncode == 0
    except subprocess.TimeoutExpired:
        has_succeeded = False
    if not has_succeeded:
        raise InputError(str(path), Unquoted("damage on which the HDF5 library hangs or crashes"), "an undamaged file")
    _probed_files.add(identity)


def _limit_resources(file_limit_s: int) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (file_limit_s, file_limit_s))
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(
        resource.RLIMIT_AS, (MEMORY_BYTES if hard == resource.RLIM_INFINITY else min(hard, MEMORY_BYTES), hard)
    )


def _extend_cpu_limit(run_limit_s: int) -> None:
    """Set the CPU limit to run_limit_s from now.

    The kernel kills the process if it makes no progress until then.
    """
    _, hard_s = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(resource.RLIMIT_CPU, (min(ceil(process_time()) + run_limit_s, hard_s), hard_s))


def _read_all(path: Path, run_limit_s: int) -> None:
    runs: list[str] = []
    plans: list[str] = []
    _extend_cpu_limit(run_limit_s)
    with suppress(InputError), Hdf5Tree(path) as tree:
        tree.read_root_attributes()
        runs = tree.list_runs()
        plans = tree.list_plans()
    for plan in plans:
        _extend_cpu_limit(run_limit_s)
        with suppress(InputError), Hdf5Tree(path) as tree:
            tree.read_plan(plan)
    for run in runs:
        _extend_cpu_limit(run_limit_s)
        with suppress(InputError), Hdf5Tree(path) as tree:
            tree.read_run_attributes(run)
            _read_members(tree, run, tree.list_members(run))


def _read_members(tree: Hdf5Tree, run: str, members: list[str]) -> None:
    for name in members:
        with suppress(InputError):
            if name in TABLE_COLUMNS:
                tree.read_table(run, name)
            elif name in SIGNALS:
                tree.read_signal_attributes(run, name)
                tree.read_samples(run, name)


def main() -> None:
    """Read the file argv[1], each run within argv[2] seconds of CPU time and all runs within argv[3].

    Invalid content is ignored here; only a crash or a timeout matters.
    """
    _limit_resources(int(sys.argv[3]))
    _read_all(Path(sys.argv[1]), int(sys.argv[2]))
