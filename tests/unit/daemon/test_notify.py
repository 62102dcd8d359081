import os
import socket

import pytest

from optodrive.core.clock import ManualClock
from optodrive.daemon.notify import Notifier


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


def heard(manager):
    said = []
    while True:
        try:
            said.append(manager.recv(4096).decode())
        except BlockingIOError:
            return said


def test_nobody_listens(make_notifier):
    notifier = make_notifier(ManualClock(), {})
    notifier.send("READY=1")
    notifier.feed_watchdog()
    assert not notifier.is_enabled


def test_what_is_told(manager, make_notifier):
    notifier = make_notifier(ManualClock(2.5), {"NOTIFY_SOCKET": manager.getsockname()})
    notifier.send("READY=1", "STATUS=well")
    notifier.notify_reloading()
    assert heard(manager) == ["READY=1\nSTATUS=well", "RELOADING=1\nMONOTONIC_USEC=2500000"]


def test_an_abstract_address(manager, make_notifier):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as abstract:
        name = f"optodrive-test-{os.getpid()}"
        abstract.bind("\0" + name)
        abstract.setblocking(False)
        make_notifier(ManualClock(), {"NOTIFY_SOCKET": "@" + name}).send("READY=1")
        assert heard(abstract) == ["READY=1"]


def test_the_watchdog_is_fed_often_enough_and_only_by_turns(manager, make_notifier):
    clock = ManualClock()
    notifier = make_notifier(clock, {"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "20000000"})
    for _ in range(2000):
        notifier.feed_watchdog()
        clock.sleep(0.01)
    assert heard(manager) == ["WATCHDOG=1"] * 5
    clock.sleep(100.0)
    assert heard(manager) == []


def test_another_process_watchdog_is_not_fed(manager, make_notifier):
    environment = {"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}
    make_notifier(ManualClock(), environment).feed_watchdog()
    assert heard(manager) == []


def test_a_manager_that_does_not_read_holds_nothing_up(manager, make_notifier):
    notifier = make_notifier(ManualClock(), {"NOTIFY_SOCKET": manager.getsockname()})
    for _ in range(5000):
        notifier.send("WATCHDOG=1")
