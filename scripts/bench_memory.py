"""Memory: PSS and RSS of each process of a daemon, and the time from its start until each is there.

The memory is read after a short stream of frames and a preview, so that what is loaded lazily counts.
"""

import subprocess
import sys
import time

from measuring import measure_times_s, running_daemon

from floods import build_full_frames
from process_memory import list_processes, read_memory_mib  # of the tests
from stop_rig import PIXELS

SETTLING_S = 3.0
LINK_IMPORTS = [sys.executable, "-c", "import optodrive.link.service.process"]


def read_memory(daemon):
    """Return PSS and RSS of each process, MiB by its name."""
    return {name: read_memory_mib(pid) for name, pid in list_processes(daemon.process.pid).items()}


def measure():
    with running_daemon():  # loads what the tests' processes are forks of
        pass
    begin_s = time.monotonic()
    with running_daemon() as (_, daemon):
        yield "from the start of board and `serve` to the first answer of its state", time.monotonic() - begin_s, "s"
        daemon.arm()
        memory = {"at rest": read_memory(daemon)}
        for _ in range(5):
            daemon.call("POST", "/v1/plans", params={"newest": True}, content=build_full_frames(1, PIXELS))
            time.sleep(0.2)
        daemon.call("POST", "/v1/plans", params={"dry_run": True}, content=build_full_frames(10, PIXELS))
        time.sleep(SETTLING_S)
        memory["after frames and a preview"] = read_memory(daemon)
    imports_s = min(measure_times_s(lambda: subprocess.run(LINK_IMPORTS, check=True), 5))
    yield "interpreter with the link process's imports, from start to end", imports_s, "s"
    for when, processes in memory.items():
        for name, (pss_mib, rss_mib) in processes.items():
            yield f"{name}, {when}: PSS", pss_mib, "MiB"
            yield f"{name}, {when}: RSS", rss_mib, "MiB"
        yield f"all processes, {when}: PSS", sum(pss_mib for pss_mib, _ in processes.values()), "MiB"
