"""A real session over serial ports, a board process, and a proxy that injects thousands of faults, in real time.

test_link_faults_virtual.py tests the same in virtual time, with short leases and queues.
"""

from math import inf
from pathlib import Path

import pytest
from pty_rig import PtyRig

from optodrive.core.errors import LinkError


@pytest.fixture(scope="module", params=["python", "host"])
def board_kind(request, ready):
    return ready(request.param, 0)


@pytest.fixture
def make_rig(board_kind, tmp_path):
    rigs = []

    def make(*faults, **more):
        folder = tmp_path / f"rig{len(rigs)}"
        folder.mkdir()
        rigs.append(PtyRig(board_kind, folder, *faults, **more))
        return rigs[-1]

    yield make
    for rig in rigs:
        if rig.board.process.poll() is None:
            rig.finish()


def states(rig):
    return [state for state, _ in rig.board.states()]


def in_mid_job(rig, ahead_s=1.0):
    rig.session.connect()
    assert rig.armed(inf)
    job = rig.begin(3000, dark_us=900, ahead_s=ahead_s)
    assert rig.until(lambda: job.executed_count > 300, inf)
    return job


def test_a_port_removed_in_mid_job_turns_the_gate_off_and_returns_disarmed(make_rig):
    rig = make_rig(10)
    in_mid_job(rig)
    rig.proxy.cut()
    with pytest.raises(LinkError):
        rig.until(lambda: False, inf)
    rig.session.disconnect()
    rig.board.wait(lambda: rig.board.states()[-1] == ("DISARMED", "link lost"), "the loss")
    assert not rig.board.is_gate_on()
    rig.board.wait(lambda: Path(rig.session.port).exists(), "the port's return")
    rig.session.connect()
    assert rig.session.board.state == "DISARMED"
    assert rig.until(lambda: False, 0.3) is False
    assert states(rig)[-1] == "DISARMED"
    assert 0 < rig.finish() < 3000
