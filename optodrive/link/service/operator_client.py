"""STOP of an operator's command, directly to the link process: it needs neither the web process nor the planner."""

import socket
import time
from pathlib import Path
from typing import Any

from optodrive.core.errors import LinkError
from optodrive.core.ipc import IpcError, Message, MessageDecoder, encode_message
from optodrive.link.service.results import build_error

TIMEOUT_S = 7.0
"""Longest wait for the result. The link process itself gives the board less."""
REQUEST_ID = 1
RETRY_S = 0.005


def stop_board(path: Path, timeout_s: float = TIMEOUT_S) -> dict[str, Any] | None:
    """Switch the gate off, drop everything queued and disarm. Return the result with the fields `board` and `epoch`.

    Return None if no link process listens at the path or this user may not open it: nothing was sent then. Raise the
    error of the link process, or LinkError if it does not answer.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        deadline_s = time.monotonic() + timeout_s
        if not _connect(connection, path, deadline_s):
            return None
        try:
            connection.sendall(encode_message(Message("hello", {"role": "operator"})))
            connection.sendall(encode_message(Message("stop", {"id": REQUEST_ID})))
            result = _await_result(connection, deadline_s)
        except (OSError, IpcError) as error:
            reason = str(error) or type(error).__name__
            raise LinkError(f"stop was not answered by {path} ({reason}): use the emergency stop or the key") from None
    if result["error"] is not None:
        raise build_error(result["error"])
    return result


def _connect(connection: socket.socket, path: Path, deadline_s: float) -> bool:
    """Connect, and wait while others connect. Return False if nobody listens or the access is denied."""
    while True:
        try:
            connection.settimeout(max(0.001, deadline_s - time.monotonic()))
            connection.connect(str(path))
        except BlockingIOError:
            if time.monotonic() > deadline_s:
                return False
            time.sleep(RETRY_S)
        except OSError:
            return False
        else:
            return True


def _await_result(connection: socket.socket, deadline_s: float) -> dict[str, Any]:
    decoder = MessageDecoder()
    while True:
        connection.settimeout(max(0.001, deadline_s - time.monotonic()))
        data = connection.recv(65_536)
        if not data:
            raise ConnectionResetError("it has ended")
        for message in decoder.feed(data):
            if message.kind == "result" and message.fields["id"] == REQUEST_ID:
                return message.fields
