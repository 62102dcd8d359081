import socket
import stat

import pytest

from optodrive.core.errors import InputError
from optodrive.daemon.web.listeners import describe_exposure, open_unix_listener


def test_a_socket_is_for_owner_and_group(tmp_path):
    with open_unix_listener(tmp_path / "s"):
        assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o660


def test_the_socket_of_a_dead_daemon_is_replaced(tmp_path):
    open_unix_listener(tmp_path / "s").close()
    with open_unix_listener(tmp_path / "s"), socket.socket(socket.AF_UNIX) as caller:
        caller.connect(str(tmp_path / "s"))


def test_a_live_socket_and_any_other_file_are_kept(tmp_path):
    with open_unix_listener(tmp_path / "s"), pytest.raises(InputError, match=r"daemon\.socket"):
        open_unix_listener(tmp_path / "s")
    (tmp_path / "file").write_text("kept")
    with pytest.raises(InputError, match=r"daemon\.socket"):
        open_unix_listener(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "kept"
    with pytest.raises(InputError, match="No such file"):
        open_unix_listener(tmp_path / "nowhere" / "s")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1", "localhost"])
def test_loopback_needs_no_warning(host):
    assert describe_exposure(host) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7", "display.example", ""])
def test_an_address_of_the_network_is_warned_of(host):
    assert "other computers can reach the daemon" in describe_exposure(host)
