"""A board that the opening of its port resets, and that starts late: it is waited for at the open port."""

import pytest
from test_session import CONFIG

from link_service_rig import WEB, ServiceRig
from optodrive.core.clock import ManualClock
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.session import board_link
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.virtual_run import MemoryLink

NO_ANSWER = "is open, but no board answers"
STARTS_S = [2.5, 8.0]
UNCERTAIN_S = 1.5
"""Longest time from the start to the next HELLO, and of the handshake."""


class ResettingLink(MemoryLink):
    """Port whose opening resets the board, as an Arduino's does. For boot_s the board neither hears nor answers.

    opened_s: times at which it was opened
    """

    boot_s = 0.0

    def __init__(self, core, clock):
        super().__init__(core, clock)
        self.opened_s = []
        self.fault = ""

    def open(self):
        self.opened_s.append(self._clock.now_s())
        self._core.reset(self._now_us())

    def describe_fault(self):
        return self.fault

    def write(self, data):
        if self._has_started:
            super().write(data)

    def read(self, timeout_s):
        data = super().read(timeout_s)
        return data if self._has_started else b""

    @property
    def _has_started(self):
        return self._clock.now_s() >= self.opened_s[-1] + self.boot_s


@pytest.fixture
def rig():
    return ServiceRig(link_type=ResettingLink).hello_all()


@pytest.mark.parametrize("boot_s", STARTS_S)
def test_a_board_that_starts_late_is_opened_once(rig, boot_s):
    rig.link.boot_s = boot_s
    rig.until(lambda: rig.boards.connected)
    assert len(rig.link.opened_s) == 1
    assert rig.clock.now_s() < rig.link.opened_s[0] + boot_s + UNCERTAIN_S
    assert rig.boards.link_error is None
    rig.arm()


@pytest.mark.parametrize("boot_s", STARTS_S)
def test_a_board_that_starts_late_is_found_again_after_a_loss(rig, boot_s):
    rig.connect()
    rig.link.boot_s = boot_s
    rig.core.reset(rig.link._now_us())
    rig.until(lambda: not rig.boards.connected)
    rig.until(lambda: rig.boards.connected, patience_s=boot_s + 5.0)
    assert len(rig.link.opened_s) == 2


@pytest.mark.parametrize("boot_s", STARTS_S)
def test_a_command_waits_for_a_board_that_starts_late(boot_s):
    clock = ManualClock(5.0)
    link = ResettingLink(BoardCore(seed=2), clock)
    link.boot_s = boot_s
    session = BoardSession(link, clock, build_board_requirements(CONFIG))
    session.connect()
    assert session.connected
    assert len(link.opened_s) == 1


def test_the_silence_is_stated_while_the_board_is_waited_for(rig):
    rig.link.boot_s = 6.0
    rig.until(lambda: rig.boards.link_error is not None and NO_ANSWER in str(rig.boards.link_error))
    assert rig.clock.now_s() < rig.link.opened_s[0] + board_link.CONNECT_TIMEOUT_S + UNCERTAIN_S
    first = rig.boards.link_error
    result = rig.await_result(WEB, rig.request(WEB, "arm"))
    assert NO_ANSWER in result["error"]["message"]
    rig.run(1.0)
    assert rig.boards.link_error is first
    rig.until(lambda: rig.boards.connected, patience_s=8.0)
    assert len(rig.link.opened_s) == 1


def test_a_port_without_an_answer_is_opened_again_in_the_end(rig, monkeypatch):
    monkeypatch.setattr(board_link, "REOPEN_S", 5.0)
    rig.link.boot_s = 1e6
    rig.until(lambda: len(rig.link.opened_s) == 2, patience_s=8.0)
    assert rig.link.opened_s[1] - rig.link.opened_s[0] >= board_link.REOPEN_S


def test_a_port_whose_settings_were_changed_before_the_board_answers_is_opened_again(rig):
    rig.link.boot_s = 1e6
    rig.until(lambda: rig.session.is_silent)
    rig.link.fault = "another program changed the settings"
    rig.until(lambda: str(rig.boards.link_error) == rig.link.fault)
    rig.link.fault = ""
    rig.until(lambda: len(rig.link.opened_s) == 2)


def test_opening_again_at_each_timeout_never_meets_the_board(rig, monkeypatch):
    monkeypatch.setattr(board_link, "REOPEN_S", board_link.CONNECT_TIMEOUT_S)
    rig.link.boot_s = 5.0
    with pytest.raises(AssertionError, match="timed out"):
        rig.until(lambda: rig.boards.connected, patience_s=12.0)
