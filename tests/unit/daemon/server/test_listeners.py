"""Warning where other computers can reach the daemon."""

import pytest

from optodrive.core.errors import InputError
from optodrive.daemon.server.listeners import build_local_url, describe_exposure, open_tcp_listener


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1", "localhost"])
def test_loopback_needs_no_warning(host):
    assert describe_exposure(host, ()) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7", "display.example", ""])
def test_an_address_of_the_network_is_warned_of(host):
    warning = describe_exposure(host, ())
    assert "other computers can reach the daemon" in warning
    assert "no name of this computer until daemon.hosts lists it" in warning
    assert describe_exposure(host, ("lab.example", "10.0.0.7")).endswith("answers at lab.example, 10.0.0.7")


@pytest.mark.parametrize(
    ("host", "url"),
    [
        ("127.0.0.1", "http://127.0.0.1:8450"),
        ("0.0.0.0", "http://127.0.0.1:8450"),
        ("::", "http://[::1]:8450"),
        ("::1", "http://[::1]:8450"),
        ("display.example", "http://display.example:8450"),
    ],
)
def test_the_printed_address_can_be_opened(host, url):
    assert build_local_url(host, 8450) == url


@pytest.mark.parametrize("host", ["192.0.2.7", "surely-no-name.invalid"])
def test_an_address_of_another_computer_is_no_port_in_use(host):
    with pytest.raises(InputError, match=r"daemon.host: got .* an address of this computer"):
        open_tcp_listener(host, 0)


def test_a_port_in_use_is_named():
    with open_tcp_listener("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(InputError, match=f"daemon.port: got {port}, expected a free port on 127.0.0.1"):
            open_tcp_listener("127.0.0.1", port)
