import pytest

from optodrive.core.errors import NotReadyError
from optodrive.daemon.reload import (
    describe_reload,
    merge_reloadable,
    require_disarmed,
    split_changed_keys,
)
from optodrive.device.config import load_config
from optodrive.link.protocol.states import LEASED_STATES


@pytest.fixture(scope="module")
def config():
    return load_config()


def with_(config, section, **changes):
    part = getattr(config, section).model_copy(update=changes)
    return config.model_copy(update={section: part})


def test_nothing_changed(config):
    assert split_changed_keys(config, load_config()) == ([], [])


def test_hosts_and_bounds_are_taken_the_rest_waits(config):
    new = with_(config, "daemon", hosts=("lab",), port=9000, body_max_bytes=2048)
    new = with_(new, "limits", absorber_max_c=300.0)
    at_once, waiting = split_changed_keys(config, new)
    assert at_once == ["daemon.body_max_bytes", "daemon.hosts"]
    assert waiting == ["daemon.port", "limits.absorber_max_c"]
    running = merge_reloadable(config, new)
    assert running.daemon.hosts == ("lab",)
    assert running.daemon.port == config.daemon.port
    assert running.limits == config.limits
    # What waits is said again at the next reload.
    assert split_changed_keys(running, new) == ([], waiting)
    assert "RESTART: daemon.port, limits.absorber_max_c" in describe_reload(at_once, waiting, None)


@pytest.mark.parametrize("state", LEASED_STATES)
def test_nothing_is_reloaded_while_armed(state):
    with pytest.raises(NotReadyError, match="disarm it first"):
        require_disarmed(state)


@pytest.mark.parametrize("state", ["DISARMED", "FAULT", "BOOT", "no link"])
def test_while_dark_it_may_be(state):
    require_disarmed(state)
