"""State of other processes of this computer, as /proc shows it."""

from pathlib import Path


def is_suspended(pid: int | None) -> bool:
    """Return whether a signal, such as SIGSTOP, has stopped a process. Return False for one that does not exist."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "Tt"
    except (OSError, IndexError):
        return False
