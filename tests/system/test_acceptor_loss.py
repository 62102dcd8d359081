"""Messages of the web process to the link process about the acceptor, over real sockets."""

import socket
import threading
import time
from pathlib import Path

import pytest

from optodrive.core.child_process import BeatWriter
from optodrive.core.ipc import IpcError, MessageSocket, open_unix_listener
from optodrive.daemon.api.access_policy import AccessPolicy
from optodrive.daemon.api.daemon_client import DaemonClient
from optodrive.daemon.api.tokens import Token, Tokens
from optodrive.daemon.runtime_folder import RuntimeFolder
from optodrive.daemon.server import acceptor_client
from optodrive.daemon.server.acceptor_client import BEAT, AcceptorClient
from optodrive.daemon.server.web_process import WebProcess
from optodrive.device.config_file import load_config
from optodrive.device.config_sections import DaemonSection
from optodrive.planning.display_model import DisplayModel


class Clock:
    """The clock of the web process's view of the acceptor, in place of the module time."""

    def __init__(self):
        self._now_s = 0.0

    def monotonic(self):
        return self._now_s

    def sleep(self, duration_s):
        self._now_s += duration_s


class WebRig:
    """A web process in a thread, with the sockets of link and acceptor."""

    def __init__(self, path, on_web_loss):
        folder = RuntimeFolder(path, path / "link.sock", 0o600, Path("nowhere"))
        link = open_unix_listener(folder.link_socket, 0o600, 1, "link")
        acceptor = open_unix_listener(folder.acceptor_socket, 0o600, 1, "acceptor", socket.SOCK_SEQPACKET)
        self._supervisor, channel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        daemon = DaemonSection(on_web_loss=on_web_loss)
        policy = AccessPolicy(Tokens([Token("viewer", "viewer", "x" * 16)]), daemon)
        display = DisplayModel.from_config(load_config("display-16"))
        client = AcceptorClient(folder.acceptor_socket)
        self._beat = BeatWriter(channel.detach())
        self._process = WebProcess(DaemonClient(display, folder), client, policy, self._beat, daemon)
        self._thread = threading.Thread(target=self._process.server.run)
        with link, acceptor:
            self._thread.start()
            self.acceptor = acceptor.accept()[0]
            self._link = MessageSocket(link.accept()[0])
        self.kinds = []

    def await_message(self, is_expected):
        """Wait until an expected message reaches the link process. Note the kinds of all messages."""
        while True:
            for message in self._link.receive():
                self.kinds.append("not alive" if message.fields.get("alive") is False else message.kind)
                if is_expected(message):
                    return
            time.sleep(0.01)

    def await_beats(self, count):
        """Wait for a number of beats to the link process."""
        for _ in range(count):
            self.await_message(lambda message: message.kind == "beat")

    def close(self):
        self._process.end()
        self._thread.join()
        self.acceptor.close()
        self._link.close()
        self._supervisor.close()
        self._beat.close()


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(acceptor_client, "time", clock)
    return clock


@pytest.fixture
def start(tmp_path, clock):
    rigs = []

    def start(on_web_loss="dark"):
        rigs.append(WebRig(tmp_path, on_web_loss))
        return rigs[-1]

    yield start
    for rig in rigs:
        rig.close()


def is_beat(alive):
    return lambda message: message.kind == "beat" and message.fields["alive"] is alive


def is_stop(message):
    return message.kind == "stop"


def test_the_lease_is_withheld_while_the_acceptor_sends_no_beats(start, clock):
    rig = start()
    rig.await_message(is_beat(True))
    for _ in range(3):
        clock.sleep(0.4 * acceptor_client.BEAT_AGE_MAX_S)
        rig.await_beats(2)  # the second one follows the passing of the time
    assert rig.kinds[-1] == "not alive"
    rig.acceptor.send(BEAT)
    rig.await_message(is_beat(True))
    assert "stop" not in rig.kinds


def test_a_web_process_that_was_suspended_itself_does_not_blame_the_acceptor(start, clock):
    rig = start()
    rig.await_message(is_beat(True))
    rig.kinds.clear()
    clock.sleep(1.5 * acceptor_client.BEAT_AGE_MAX_S)  # between two of its own beats
    rig.await_beats(3)
    assert "not alive" not in rig.kinds


def test_the_end_of_the_acceptor_stops_the_board(start):
    rig = start()
    rig.await_message(is_beat(True))
    assert "stop" not in rig.kinds
    rig.acceptor.close()
    rig.await_message(is_stop)
    rig.await_message(is_beat(False))


def test_a_plan_may_finish_without_the_acceptor_if_so_configured(start):
    rig = start("finish")
    rig.await_message(is_beat(True))
    rig.acceptor.close()
    rig.await_message(is_beat(False))
    assert "stop" not in rig.kinds


def test_the_board_is_stopped_before_the_last_client_has_gone(start):
    rig = start()
    rig.await_message(is_beat(True))
    rig._process.end()
    with pytest.raises(IpcError):
        rig.await_message(lambda message: False)
    assert "stop" in rig.kinds
