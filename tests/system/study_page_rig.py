"""A person's session on pages: the process of the study with the addresses of its pages."""

import json
import os
import re
import subprocess
from base64 import urlsafe_b64encode
from contextlib import contextmanager

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from forked_process import OPTODRIVE, start_process
from rig import TOKEN


class PageStudy:
    """Process of `optodrive study --page` on a daemon, for participant 07."""

    def __init__(self, folder, daemon, study, *arguments, port=0):
        self.process = start_process(
            [
                *(OPTODRIVE, "study", study, "--out", folder / "data", "--participant", "07"),
                *("--page", str(port), "--url", daemon.url, *arguments),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "OPTODRIVE_TOKEN": TOKEN, "XDG_RUNTIME_DIR": str(folder)},
        )
        self.urls, self.said = {}, ""

    def read_urls(self):
        """Wait for the addresses of both pages. Return whether they came; if not, the process has ended."""
        while len(self.urls) < 2 and (line := self.process.stderr.readline()):
            self.said += line
            found = re.match(r"(participant|operator) +(http://\S+)$", line)
            if found:
                self.urls[found[1]] = found[2]
        return len(self.urls) == 2

    def end(self):
        """Wait for the end of the process and return its status. An error is one line."""
        _, errors = self.process.communicate()
        self.said += errors
        assert "Traceback" not in self.said, self.said
        return self.process.returncode

    def kill(self):
        self.process.kill()
        self.process.communicate()


class Wire:
    """A page without a browser."""

    def __init__(self, socket):
        self.socket = socket

    def wait_for(self, *phases):
        while (view := json.loads(self.socket.recv()))["phase"] not in phases:
            pass
        return view

    def send(self, kind, **fields):
        self.socket.send(json.dumps({"kind": kind, **fields}))

    def read_close(self):
        """Read until the server closes the socket. Return the code, and the number of messages before."""
        count = 0
        try:
            while True:
                self.socket.recv()
                count += 1
        except ConnectionClosed as closed:
            return closed.rcvd.code, count


@contextmanager
def open_wire(url, role="participant", **options):
    """Open the WebSocket of a page with the token of an address."""
    base, _, token = url.partition("#token=")
    path = base.replace("http", "ws").rpartition("/")[0] + f"/{role}/socket"
    offered = f"bearer.{urlsafe_b64encode(token.encode()).decode().rstrip('=')}"
    with connect(path, subprotocols=["optodrive", offered], **options) as socket:
        yield Wire(socket)
