"""Pushes on sockets of their own, step by step, and the processes that compute dry runs."""

import json
import os
import signal
import socket
from contextlib import contextmanager, suppress

from rig import TOKEN, read_proc, read_role_tokens


class RawPush:
    """A push of which the web process has read the head, and waits for the body."""

    def __init__(self, daemon, body_bytes, path="/v1/plans", secret=TOKEN):
        base = daemon.client.base_url
        self._link = socket.create_connection((base.host, base.port))
        self._received = b""
        head = f"POST {path} HTTP/1.1\r\nHost: {base.host}\r\nContent-Length: {body_bytes}\r\n"
        head += f"Authorization: Bearer {secret}\r\nExpect: 100-continue\r\n\r\n"
        self._link.sendall(head.encode())
        status, _ = self._receive_head()
        assert status == 100, f"answered {status} before the body"

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._link.close()

    def send(self, data):
        """Send a part of the body."""
        self._link.sendall(data)

    def receive(self):
        """Return the status and the document of the answer."""
        status, headers = self._receive_head()
        while len(self._received) < int(headers["content-length"]):
            self._receive_more()
        return status, json.loads(self._received)

    def _receive_head(self):
        while b"\r\n\r\n" not in self._received:
            self._receive_more()
        head, _, self._received = self._received.partition(b"\r\n\r\n")
        first, *lines = head.decode().split("\r\n")
        return int(first.split()[1]), dict(line.lower().split(": ", 1) for line in lines)

    def _receive_more(self):
        data = self._link.recv(1 << 16)
        assert data, "the daemon hung up"
        self._received += data


@contextmanager
def sent_dry_run(daemon, body):
    """Send an operator's dry run, and hang up at the end of the context without reading an answer."""
    path, secret = "/v1/plans?dry_run=true", read_role_tokens(daemon)["operator"]
    with RawPush(daemon, len(body), path, secret) as push:
        push.send(body)
        yield


def find_dry_runs(daemon):
    """Return the ids of the processes of low priority that work for a caller: on a dry run, or on a slow build."""
    preview, found = daemon.find_process("preview"), []
    usual = os.getpriority(os.PRIO_PROCESS, preview)
    for pid in map(int, read_proc(preview, f"task/{preview}/children").split()):
        with suppress(ProcessLookupError):  # it has ended meanwhile
            if os.getpriority(os.PRIO_PROCESS, pid) > usual:
                found.append(pid)
    return found


def suspend_dry_runs(daemon):
    """Suspend the processes that `find_dry_runs` finds, and return their ids."""
    suspended = []
    for pid in find_dry_runs(daemon):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
            suspended.append(pid)
    return suspended
