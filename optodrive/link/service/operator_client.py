"""STOP of an operator's command, directly to the link process: it needs neither the web process nor the planner."""

import time
from pathlib import Path
from typing import Any

from optodrive.core.clock import MonotonicClock
from optodrive.core.errors import LinkError
from optodrive.link.service.link_connection import LinkConnection
from optodrive.link.service.results import build_error

TIMEOUT_S = 7.0
"""Longest wait for the result. The link process itself gives the board less."""
RETRY_S = 0.005


def stop_board(path: Path, timeout_s: float = TIMEOUT_S) -> dict[str, Any] | None:
    """Switch the gate off, drop everything queued and disarm. Return the result with the fields `board` and `epoch`.

    Return None if no link process listens at the path or this user may not open it: nothing was sent then. Raise the
    error of the link process, or LinkError if it does not answer.
    """
    clock = MonotonicClock()
    deadline_s = clock.now_s() + timeout_s
    connection = LinkConnection(path, "operator", clock)
    while True:
        try:
            connection.open()
            break
        except BlockingIOError:  # others connect
            if clock.now_s() > deadline_s:
                return None
            time.sleep(RETRY_S)
        except OSError:
            return None
    result = connection.request("stop", {}, deadline_s - clock.now_s())
    connection.close()
    if result is None:
        reason = connection.end_reason
        raise LinkError(f"stop was not answered at {path} ({reason}): use the emergency stop or the key")
    if result["error"] is not None:
        raise build_error(result["error"])
    return result
