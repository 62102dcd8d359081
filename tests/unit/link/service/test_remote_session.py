"""The planner's session while the link process stalls, in virtual time: when it gives up, and when the lease ends."""

from types import SimpleNamespace

import pytest

from link_service_rig import PLANNER, SUPERVISOR
from optodrive.link.protocol.states import BoardState
from optodrive.link.service import link_connection
from optodrive.link.service.control import BEAT_AGE_MAX_S
from optodrive.link.service.remote_session import REPLY_TIMEOUT_S
from optodrive.link.service.status import NO_EPOCH
from planner_rig import PlannerRig, ServiceChannel, build_train

POLL_S = 0.01
LEASE_S = 0.1


class StallingChannel(ServiceChannel):
    """Channel to a link process that reads and answers nothing until a time."""

    def __init__(self, rig):
        super().__init__(rig)
        self.stalled_until_s = 0.0
        self._waiting = []

    def send(self, message):
        self._waiting.append(message)
        self._deliver()

    def _deliver(self):
        if self._rig.clock.now_s() >= self.stalled_until_s:
            waiting, self._waiting = self._waiting, []
            for message in waiting:
                super().send(message)

    def receive(self):
        self._deliver()
        return [] if self._rig.clock.now_s() < self.stalled_until_s else super().receive()


@pytest.fixture
def rig(monkeypatch):
    rig = PlannerRig(monkeypatch).ready()
    rig.channel = StallingChannel(rig)
    rig.channel._read = len(rig.received[PLANNER])
    rig.remote.connection.attach(rig.channel)
    rig.arm()
    rig.run(0.01)
    rig.submit(build_train(3.0), rig.remote.epoch).result()
    rig.until(lambda: rig.core.state == BoardState.RUNNING)
    # The planner waits in select(); meanwhile time passes, and nothing else.
    waiting = SimpleNamespace(select=lambda *arguments: rig.clock.sleep(min(POLL_S, arguments[-1])))
    monkeypatch.setattr(link_connection, "select", waiting)
    return rig


def truncate_during_a_stall(rig, stall_s):
    """Request that the running job ends later than it does. Return how long the planner waited, s."""
    began_s = rig.clock.now_s()
    rig.channel.stalled_until_s = began_s + stall_s
    rig.remote.truncate([10_000])
    return rig.clock.now_s() - began_s


@pytest.mark.parametrize("stall_s", [0.0, 0.2, REPLY_TIMEOUT_S - POLL_S])
def test_a_stall_of_the_link_process_that_is_shorter_is_waited_for(rig, stall_s):
    epoch = rig.remote.epoch
    assert truncate_during_a_stall(rig, stall_s) == pytest.approx(stall_s, abs=1.5 * POLL_S)
    assert rig.remote.connection.is_open
    assert rig.remote.epoch == epoch


@pytest.mark.parametrize("stall_s", [REPLY_TIMEOUT_S + 2 * POLL_S, 10.0])
def test_the_planner_gives_up_a_link_process_that_stalls_for_longer(rig, stall_s):
    waited_s = truncate_during_a_stall(rig, stall_s)
    assert waited_s == pytest.approx(REPLY_TIMEOUT_S, abs=1.5 * POLL_S)
    assert not rig.remote.connection.is_open
    assert rig.remote.epoch == NO_EPOCH
    assert f"did not answer truncate within {REPLY_TIMEOUT_S:g} s" in rig.remote.epoch_reason
    rig.service.step()
    assert rig.core.state != BoardState.RUNNING, "the link process sees the end of its planner, and goes dark"


def test_a_planner_that_waits_is_not_itself_counted_as_stalled():
    """A wait leaves time for a beat before the link process withholds the lease for want of one."""
    assert REPLY_TIMEOUT_S + 2 * LEASE_S < BEAT_AGE_MAX_S


def test_without_a_beat_the_lease_is_withheld_after_a_second_and_not_earlier(monkeypatch):
    rig = PlannerRig(monkeypatch).ready()
    rig.arm()
    rig.run(0.1)
    beaten_s = rig.clock.now_s()
    rig.alive[PLANNER] = None
    while rig.core.fault != "LINK":
        stalled = rig.of_kind(SUPERVISOR, "status")[-1].fields["stalled"]
        assert stalled in ("", "planner")
        assert not stalled or rig.clock.now_s() - beaten_s > BEAT_AGE_MAX_S - 0.01
        rig.run(POLL_S)
    assert BEAT_AGE_MAX_S < rig.clock.now_s() - beaten_s < BEAT_AGE_MAX_S + LEASE_S + 3 * POLL_S
