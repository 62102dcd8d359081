"""The real link process with a stand-in for its supervisor, and its clients."""

import json
import os
import select
import socket
import subprocess
import sys
import time
from dataclasses import replace

from optodrive.core.clock import MonotonicClock
from optodrive.core.ipc import IpcError, Message, MessageSocket
from optodrive.device.config_file import load_config
from optodrive.link.board_setup import build_link_settings, build_scales
from optodrive.link.service.remote_session import RemoteSession
from optodrive.link.transport.base import PortSettings

CONFIG = load_config("display-16")
BEAT_INTERVAL_S = 0.05
LINK_PROCESS = sys.executable, "-m", "optodrive.link.service.process"


class LinkProcess:
    """Link process on a board's port."""

    def __init__(self, folder, port, lease_s=1.0, config=CONFIG, **settings):
        self.path = folder / "link.sock"
        built = build_link_settings(config, self.path, 0o600, settings.pop("capture_path", None))
        (board,) = built.boards
        limits = replace(board.requirements.limits, lease_ms=round(lease_s * 1e3))
        requirements = replace(board.requirements, lease_s=lease_s, limits=limits)
        board = replace(board, port=PortSettings("serial", str(port)), requirements=requirements)
        built = replace(built, boards=(board,), **settings)
        file = folder / "link.json"
        file.write_text(built.to_json())
        self.supervisor, channel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.process = subprocess.Popen(
            [*LINK_PROCESS, "--settings", file, "--supervisor", str(channel.fileno())],
            pass_fds=[channel.fileno()],
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        )
        channel.close()
        self.reports = [self.receive_report()]
        while self.reports[-1]["kind"] == "beat":
            self.reports.append(self.receive_report())
        self.clients, self.planner = [], None

    def receive_report(self):
        packet = self.supervisor.recv(256_000)
        return json.loads(packet) if packet else {"kind": "end"}

    def open_planner(self):
        self.planner = RemoteSession(build_scales(CONFIG), self.path, MonotonicClock())
        self.planner.connect_if_due()
        return self.planner

    def open_client(self, role):
        client = Client(self.path, role)
        self.clients.append(client)
        return client

    def run(self, duration_s=BEAT_INTERVAL_S):
        """Beat as planner and web, and process the messages that arrive."""
        until_s = time.monotonic() + duration_s
        while time.monotonic() < until_s:
            self.planner.beat(True)
            for client in self.clients:
                client.beat()
            watched = [item for item in (self.planner.connection, *self.clients) if item.fileno() >= 0]
            select.select(watched, [], [], min(BEAT_INTERVAL_S, duration_s))
            self.planner.connection.receive()
            for client in self.clients:
                client.receive()

    def until(self, condition):
        while not (result := condition()):
            self.run(0.005)
        return result

    def await_result(self, client, kind):
        request_id = client.request(kind)
        return self.until(lambda: client.results.get(request_id))

    def stop(self):
        for client in (*self.clients, self.planner and self.planner.connection):
            if client is not None:
                client.close()
        self.supervisor.close()
        self.process.wait()


class Client:
    """Client with a role.

    status: latest status
    results: by request
    """

    def __init__(self, path, role):
        self.role, self.status, self.results = role, None, {}
        self._socket = MessageSocket.connect(path)
        self._socket.send(Message("hello", {"role": role}))
        self._request_id = 0

    def fileno(self):
        return self._socket.fileno()

    @property
    def is_closed(self):
        return self._socket.is_closed

    def request(self, kind):
        self._request_id += 1
        self._socket.send(Message(kind, {"id": self._request_id}))
        return self._request_id

    def beat(self):
        if self.role == "web" and not self._socket.is_closed:
            self._socket.send(Message("beat", {"alive": True}))

    def receive(self):
        try:
            messages = self._socket.receive()
        except IpcError:
            return
        for message in messages:
            if message.kind == "status":
                self.status = message.fields
            elif message.kind == "result":
                self.results[message.fields["id"]] = message.fields

    def close(self):
        self._socket.close()
