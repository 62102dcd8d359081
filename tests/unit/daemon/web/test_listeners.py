"""Warning where other computers can reach the daemon."""

import pytest

from optodrive.daemon.web.listeners import describe_exposure


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1", "localhost"])
def test_loopback_needs_no_warning(host):
    assert describe_exposure(host) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7", "display.example", ""])
def test_an_address_of_the_network_is_warned_of(host):
    assert "other computers can reach the daemon" in describe_exposure(host)
