"""Processes of a daemon and their memory, from /proc."""

from pathlib import Path


def list_tree(pid):
    """Return a process and its descendants without those that have ended."""
    pids = [pid]
    try:
        for task in Path(f"/proc/{pid}/task").iterdir():
            pids += [found for child in (task / "children").read_text().split() for found in list_tree(int(child))]
    except OSError:
        return pids if Path(f"/proc/{pid}").exists() else []
    return pids


def list_processes(pid):
    """Return the processes of a daemon by name. A number tells those of one name apart."""
    processes = {}
    for process in list_tree(pid):
        try:
            name = Path(f"/proc/{process}/comm").read_text().strip()
        except OSError:  # it has ended meanwhile
            continue
        processes[name if name not in processes else f"{name} {process}"] = process
    return processes


def read_memory_mib(pid):
    """Return the proportional (PSS) and the resident memory (RSS) of a process, MiB, 0 if it has ended."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0, 0.0
    kib = {line.split(":")[0]: int(line.split()[1]) for line in lines[1:]}
    return kib["Pss"] / 1024, kib["Rss"] / 1024


def read_peak_mib(pid):
    """Return the peak resident memory of a process so far, MiB, 0 if it has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) for line in lines if line.startswith("VmHWM")), 0) / 1024
