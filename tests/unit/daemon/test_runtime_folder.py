import os
import stat
from pathlib import Path

import pytest

from optodrive.core.errors import InputError
from optodrive.daemon.runtime_folder import SOCKET_PATH_MAX_BYTES, find_link_socket, open_runtime_folder


@pytest.fixture(params=["short", "a-folder-" + "far-too-long-for-a-socket-" * 5])
def runtime(request, tmp_path, monkeypatch):
    """Return the user's runtime folder, with a short path and with one in which no socket fits."""
    folder = tmp_path / request.param
    folder.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder


def test_sockets_fit_and_only_the_user_can_open_them(runtime):
    folder = open_runtime_folder(8450, None)
    try:
        assert stat.S_IMODE(folder.path.stat().st_mode) == 0o700
        for path in (folder.link_socket, folder.planner_socket, folder.preview_socket):
            assert len(str(path)) <= SOCKET_PATH_MAX_BYTES + len("planner.sock")
        assert find_link_socket(8450, None) == folder.link_socket
        assert folder.link_socket_mode == 0o600
    finally:
        folder.remove()
    assert not folder.path.exists()
    assert list((runtime / "optodrive").iterdir()) == []


def test_what_a_killed_daemon_left_is_replaced(runtime):
    first = open_runtime_folder(8450, None)
    first.planner_socket.touch()
    second = open_runtime_folder(8450, None)
    try:
        assert not second.planner_socket.exists()
        assert first.path == second.path or not first.path.exists()
    finally:
        second.remove()


def test_the_link_socket_lies_beside_the_configured_one(runtime):
    folder = open_runtime_folder(8450, Path("/run/optodrive/optodrive.sock"))
    folder.remove()
    assert folder.link_socket == Path("/run/optodrive/optodrive-link.sock")
    assert folder.link_socket == find_link_socket(None, Path("/run/optodrive/optodrive.sock"))
    assert folder.link_socket_mode == 0o660


def test_a_socket_path_without_room_for_the_link_is_refused(runtime):
    with pytest.raises(InputError, match=r"daemon\.socket"):
        open_runtime_folder(8450, Path("/run") / ("x" * SOCKET_PATH_MAX_BYTES))


def test_a_link_to_another_folder_is_not_followed(runtime, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (runtime / "optodrive").mkdir()
    (runtime / "optodrive" / "daemon-8450").symlink_to(other)
    open_runtime_folder(8450, None).remove()
    assert other.exists()


def test_folders_and_tokens_of_daemons_without_a_process_are_removed(runtime):
    """Those of a running daemon on another port stay, also while only a child of it is left."""
    running, killed = open_runtime_folder(8450, None), open_runtime_folder(8451, None)
    child_lock = os.dup(running.lock)  # as a fork inherits it
    os.close(running.lock)
    os.close(killed.lock)
    for port in (8450, 8451):
        (runtime / "optodrive" / f"token-{port}").touch()
    (runtime / "optodrive" / "daemon-8452").symlink_to(runtime / "gone")
    (runtime / "optodrive" / "notes").mkdir()
    own = open_runtime_folder(8453, None)
    names = {path.name for path in (runtime / "optodrive").iterdir()}
    assert names == {"daemon-8450", "token-8450", "daemon-8453", "notes"}
    assert running.path.exists()
    assert not killed.path.exists()
    os.close(child_lock)
    own.remove()
    open_runtime_folder(8453, None).remove()
    assert {path.name for path in (runtime / "optodrive").iterdir()} == {"notes"}
