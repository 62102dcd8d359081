"""The sockets at which `optodrive stop` looks for the link process."""

import json
import os
import socket
import struct
import subprocess
import sys
import sysconfig
import threading
from pathlib import Path

import pytest

from optodrive.cli import main
from optodrive.cli.direct_stop import list_link_sockets, stop_directly
from optodrive.cli.main import run
from optodrive.core.ipc import Message, MessageDecoder, encode_message
from optodrive.daemon.runtime_folder import open_runtime_folder

BOARD = {"state": "DISARMED", "fault": None, "hint": ""}


@pytest.fixture
def runtime(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("OPTODRIVE_TOKEN", "a-token-for-tests")
    return tmp_path


def serve_once(path, answer, inspect=lambda connection: None):
    """Answer one STOP in place of the link process. Return the thread and the list of kinds received.

    inspect: called with the connection on which STOP has come, before the answer
    """
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen()
    kinds = []

    def serve():
        connection, _ = listener.accept()
        decoder = MessageDecoder()
        with connection, listener:
            while "stop" not in kinds:
                kinds.extend(message.kind for message in decoder.feed(connection.recv(4096)))
            inspect(connection)
            connection.sendall(encode_message(answer))

    thread = threading.Thread(target=serve)
    thread.start()
    return thread, kinds


def find_free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.parametrize(
    ("url", "names"),
    [
        ("http://127.0.0.1:9000", ["optodrive/daemon-9000/link.sock"]),
        ("http://localhost:8450", ["optodrive/daemon-8450/link.sock", "/run/optodrive/optodrive-link.sock"]),
        ("unix:/run/optodrive/optodrive.sock", ["/run/optodrive/optodrive-link.sock"]),
        ("http://laser-room:8450", []),
    ],
)
def test_only_sockets_of_the_daemon_at_the_url_are_tried(runtime, url, names):
    assert list_link_sockets(url) == [runtime / name for name in names]


def test_a_shared_socket_is_found_by_the_tcp_port_too(runtime):
    unix = runtime / "shared.sock"
    folder = open_runtime_folder(9000, unix)
    thread, kinds = serve_once(folder.link_socket, Message("result", {"id": 1, "error": None, "board": BOARD}))
    assert stop_directly("http://127.0.0.1:9000")["board"] == BOARD
    thread.join()
    assert kinds == ["hello", "stop"]
    folder.remove()
    assert not os.path.lexists(folder.path)


def test_without_a_daemon_nothing_is_stopped(runtime):
    assert stop_directly("http://127.0.0.1:9000") is None


def test_the_command_stops_although_no_web_process_answers(runtime, capsys):
    port = find_free_port()
    folder = open_runtime_folder(port, None)
    thread, _ = serve_once(folder.link_socket, Message("result", {"id": 1, "error": None, "board": BOARD}))
    assert run(["stop", "--url", f"http://127.0.0.1:{port}", "--json"]) == 0
    thread.join()
    printed = capsys.readouterr()
    assert json.loads(printed.out) == {"board": BOARD}
    assert "the board was stopped" in printed.err


def test_stop_leaves_before_the_command_line_is_imported(runtime):
    port = find_free_port()
    folder = open_runtime_folder(port, None)
    packages = sysconfig.get_path("purelib")
    mapped = []

    def inspect(connection):
        pid, _, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        mapped.append(Path(f"/proc/{pid}/maps").read_text())

    answer = Message("result", {"id": 1, "error": None, "board": BOARD})
    thread, _ = serve_once(folder.link_socket, answer, inspect)
    command = [sys.executable, "-m", "optodrive.cli.main", "stop", f"--url=http://127.0.0.1:{port}", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    output, _ = process.communicate()
    thread.join()
    assert json.loads(output) == {"board": BOARD}
    assert packages not in mapped[0]  # pydantic and numpy are libraries there
    assert process.returncode == 0


@pytest.mark.parametrize("options", [["--help"], ["--url"], ["now"], ["--url=http://127.0.0.1:1", "--jason"]])
def test_what_is_not_plainly_stop_takes_the_usual_way(runtime, monkeypatch, options):
    monkeypatch.setattr(main, "stop_directly", lambda url: pytest.fail(f"stopped at {url}") if url else None)
    assert main.run(["stop", *options]) == (0 if options == ["--help"] else 2)


def test_an_error_of_the_link_process_is_the_commands_error(runtime, capsys):
    port = find_free_port()
    folder = open_runtime_folder(port, None)
    error = {"code": "link", "message": "no link to the board", "type": "LinkError"}
    thread, _ = serve_once(folder.link_socket, Message("result", {"id": 1, "error": error, "board": BOARD}))
    assert run(["stop", "--url", f"http://127.0.0.1:{port}"]) == 1
    thread.join()
    assert capsys.readouterr().err == "optodrive: no link to the board\n"


def test_a_link_process_that_ends_instead_of_answering_is_an_error(runtime, capsys):
    port = find_free_port()
    folder = open_runtime_folder(port, None)
    thread, _ = serve_once(folder.link_socket, Message("status", {}))
    assert run(["stop", "--url", f"http://127.0.0.1:{port}"]) == 1
    thread.join()
    assert "use the emergency stop or the key" in capsys.readouterr().err
