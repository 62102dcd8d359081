"""Listening Unix sockets: their mode, and the files that they replace."""

import socket
import stat

import pytest

from optodrive.core.errors import InputError
from optodrive.core.ipc import open_unix_listener


def listen(path):
    return open_unix_listener(path, 0o660, 8, "the place")


def test_a_socket_is_for_owner_and_group(tmp_path):
    with listen(tmp_path / "s"):
        assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o660


def test_the_socket_of_a_dead_daemon_is_replaced(tmp_path):
    listen(tmp_path / "s").close()
    with listen(tmp_path / "s"), socket.socket(socket.AF_UNIX) as caller:
        caller.connect(str(tmp_path / "s"))


def test_a_live_socket_and_any_other_file_are_kept(tmp_path):
    with listen(tmp_path / "s"), pytest.raises(InputError, match="the place"):
        listen(tmp_path / "s")
    (tmp_path / "file").write_text("kept")
    with pytest.raises(InputError, match="the place"):
        listen(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "kept"
    with pytest.raises(InputError, match="No such file"):
        listen(tmp_path / "nowhere" / "s")
