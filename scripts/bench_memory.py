"""Benchmark of memory: PSS and RSS of each process of a daemon, and the time from its start until each is there.

The memory is read after a short stream of frames and a preview, so that what is loaded lazily counts.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parent.parent / "tests" / "system")]
from floods import build_full_frames  # noqa: E402 - of the tests
from process_memory import list_processes, read_memory_mib  # noqa: E402
from rig import Board, Daemon  # noqa: E402
from stop_rig import PIXELS  # noqa: E402

SETTLING_S = 3.0
RUNS = 5
LINK_IMPORTS = "import optodrive.link.service.process"


def measure_link_imports_s():
    """Return the shortest time of an interpreter that only imports the link process's modules, s."""
    times = []
    for _ in range(RUNS):
        begin_s = time.monotonic()
        subprocess.run([sys.executable, "-c", LINK_IMPORTS], check=True)
        times.append(time.monotonic() - begin_s)
    return min(times)


def bench_memory():
    """Return the rows of the table."""
    with tempfile.TemporaryDirectory() as folder:
        board = Board(Path(folder))
        try:
            begin_s = time.monotonic()
            daemon = Daemon(Path(folder), board.port)
            ready_s = time.monotonic() - begin_s
            try:
                daemon.arm()
                idle = {name: read_memory_mib(pid) for name, pid in list_processes(daemon.process.pid).items()}
                for _ in range(5):
                    daemon.call("POST", "/v1/plans", params={"newest": True}, content=build_full_frames(1, PIXELS))
                    time.sleep(0.2)
                daemon.call("POST", "/v1/plans", params={"dry_run": True}, content=build_full_frames(10, PIXELS))
                time.sleep(SETTLING_S)
                used = {name: read_memory_mib(pid) for name, pid in list_processes(daemon.process.pid).items()}
            finally:
                daemon.stop()
        finally:
            board.stop()
    rows = [("from the start of `serve` to the first answer of its state", ready_s, "s")]
    rows.append(("interpreter with the link process's imports, from start to end", measure_link_imports_s(), "s"))
    for when, memory in (("at rest", idle), ("after frames and a preview", used)):
        for name, (pss_mib, rss_mib) in memory.items():
            rows += [(f"{name}, {when}: PSS", pss_mib, "MiB"), (f"{name}, {when}: RSS", rss_mib, "MiB")]
        rows.append((f"all processes, {when}: PSS", sum(pss_mib for pss_mib, _ in memory.values()), "MiB"))
    return rows


if __name__ == "__main__":
    for what, value, unit in bench_memory():
        print(f"{value:10.2f} {unit:4} {what}")
