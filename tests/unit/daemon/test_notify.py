import os
import socket

import pytest

from optodrive.core.clock import ManualClock
from optodrive.daemon.log import Notifier


@pytest.fixture
def make_notifier():
    made = []

    def make(*given):
        made.append(Notifier(*given))
        return made[-1]

    yield make
    for notifier in made:
        notifier.close()


@pytest.fixture
def manager(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.setblocking(False)
        yield listener


def receive_all(manager):
    received = []
    while True:
        try:
            received.append(manager.recv(4096).decode())
        except BlockingIOError:
            return received


def test_without_a_socket_nothing_is_sent(make_notifier):
    notifier = make_notifier(ManualClock(), {})
    notifier.send("READY=1")
    notifier.feed_watchdog()
    assert not notifier.is_enabled


def test_notifications(manager, make_notifier):
    notifier = make_notifier(ManualClock(2.5), {"NOTIFY_SOCKET": manager.getsockname()})
    notifier.send("READY=1", "STATUS=ok")
    notifier.notify_reloading()
    assert receive_all(manager) == ["READY=1\nSTATUS=ok", "RELOADING=1\nMONOTONIC_USEC=2500000"]


def test_an_abstract_address(manager, make_notifier):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as abstract:
        name = f"optodrive-test-{os.getpid()}"
        abstract.bind("\0" + name)
        abstract.setblocking(False)
        make_notifier(ManualClock(), {"NOTIFY_SOCKET": "@" + name}).send("READY=1")
        assert receive_all(abstract) == ["READY=1"]


def test_the_watchdog_is_fed_at_its_interval_and_only_by_calls(manager, make_notifier):
    clock = ManualClock()
    notifier = make_notifier(clock, {"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "20000000"})
    for _ in range(2000):
        notifier.feed_watchdog()
        clock.sleep(0.01)
    assert receive_all(manager) == ["WATCHDOG=1"] * 5
    clock.sleep(100.0)
    assert receive_all(manager) == []


def test_another_process_watchdog_is_not_fed(manager, make_notifier):
    environment = {"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}
    make_notifier(ManualClock(), environment).feed_watchdog()
    assert receive_all(manager) == []


def test_a_manager_that_does_not_read_does_not_block(manager, make_notifier):
    notifier = make_notifier(ManualClock(), {"NOTIFY_SOCKET": manager.getsockname()})
    for _ in range(5000):
        notifier.send("WATCHDOG=1")
