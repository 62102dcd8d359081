"""A trial of an HDF5 file in a process of its own.

The HDF5 library was not made for damaged files: some bytes changed make it run for ever or crash, and the process that
called it with it. What a short-lived process has read from end to end is safe to be read here.
"""

import os
import resource
import subprocess
import sys
from contextlib import suppress
from math import ceil
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING

from optodrive.core.errors import InputError
from optodrive.lab.recording.storage import SIGNALS, TABLES, Words

if TYPE_CHECKING:
    from optodrive.lab.recording.hdf5 import Hdf5Tree

CPU_S = 5
BYTES_PER_CPU_S = 20_000_000
"""A run may take `CPU_S`, and a second more for so many bytes of the file; even compressed data is read faster."""
BYTES_PER_CPU_S_ALL = 200_000
"""The whole may take `CPU_S`, and a second more for so many bytes: a run takes milliseconds, however small it is."""
MEMORY_BYTES = 2**32
_PROGRAM = "from optodrive.lab.recording.sandboxed_probe import main; main()"
_SETTINGS = {"OPENBLAS_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
_passed: set[tuple[str, int, int, int, int]] = set()


def try_out(path: Path) -> None:
    """Read the file in a process of its own; InputError where that process comes to grief. Once a file and process."""
    status = path.stat()
    identity = (str(path.resolve()), status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
    if identity in _passed:
        return
    each_s = CPU_S + status.st_size // BYTES_PER_CPU_S
    all_s = CPU_S + status.st_size // BYTES_PER_CPU_S_ALL
    try:
        finished = subprocess.run(
            [sys.executable, "-P", "-c", _PROGRAM, str(path.absolute()), str(each_s), str(all_s)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **_SETTINGS, "PYTHONPATH": os.pathsep.join(sys.path)},
            timeout=20 * all_s,
            check=False,
        )
        ended_well = finished.returncode == 0
    except subprocess.TimeoutExpired:
        ended_well = False
    if not ended_well:
        raise InputError(str(path), Words("damage on which the HDF5 library hangs or crashes"), "an undamaged file")
    _passed.add(identity)


def _confine(all_s: int) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (all_s, all_s))
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(
        resource.RLIMIT_AS, (MEMORY_BYTES if hard == resource.RLIM_INFINITY else min(hard, MEMORY_BYTES), hard)
    )


def _more(each_s: int) -> None:
    """Let the process run for so many seconds from now on, and then be killed, for then it makes no headway."""
    _, hard_s = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(resource.RLIMIT_CPU, (min(ceil(process_time()) + each_s, hard_s), hard_s))


def _read_all(path: Path, each_s: int) -> None:
    from optodrive.lab.recording.hdf5 import Hdf5Tree

    runs: list[str] = []
    _more(each_s)
    with suppress(InputError), Hdf5Tree(path, trusted=True) as tree:
        tree.head()
        runs = tree.runs()
    for run in runs:
        _more(each_s)
        with suppress(InputError), Hdf5Tree(path, trusted=True) as tree:
            tree.attributes(run)
            _read_members(tree, run, tree.members(run))


def _read_members(tree: "Hdf5Tree", run: str, members: list[str]) -> None:
    for name in members:
        with suppress(InputError):
            if name in TABLES:
                tree.table(run, name)
            elif name in SIGNALS:
                tree.signal_attributes(run, name)
                tree.samples(run, name)


def main() -> None:
    """The process: read the file named first, each run within the seconds named second, all within those named third.

    What is merely wrong is passed over.
    """
    _confine(int(sys.argv[3]))
    _read_all(Path(sys.argv[1]), int(sys.argv[2]))
