"""A real session over serial ports, a board process, and a proxy that injects thousands of faults, in real time.

test_link_faults_virtual.py tests the same in virtual time, with short leases and queues.
"""

import random
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from math import inf
from pathlib import Path
from threading import Timer

import pytest
from pty_rig import PtyRig
from wire_format import HOST

from optodrive.core.errors import LinkError

FAULT_RATES = [(1, 0.01), (2, 0.03), (3, 0.08), (4, 0.2)]
SESSIONS = 3
KINDS = 11
"""Number of fault kinds; the close of a port is another one."""


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


@pytest.mark.slow
def test_under_link_faults_each_pulse_is_as_sent_once_and_in_order(make_rig):
    def run_fault_sessions(rig):
        rig.up.never_again = tuple(HOST[name][0] for name in ("HELLO", "ABORT"))
        for _ in range(SESSIONS):
            rig.live(1500, patience_s=3.0)
        return rig.finish()

    rigs = [make_rig(seed, loss, extra=0.6, pauses=0.002) for seed, loss in FAULT_RATES]
    with ThreadPoolExecutor(len(rigs)) as pool:
        pulses = list(pool.map(run_fault_sessions, rigs))
    faults = sum(rig.faults for rig in rigs)
    assert len(sum((rig.up.counts + rig.down.counts for rig in rigs), Counter())) == KINDS
    print(f"{faults} faults over ptys, {len(rigs) * SESSIONS} sessions, pulses {pulses}")
    assert faults >= 3000
    assert sum(pulses) > 0


@pytest.mark.slow
def test_no_underrun_at_five_percent_loss_with_a_queue_of_a_second(make_rig):
    rig = make_rig(7)
    rig.session.connect()
    assert rig.armed(inf)
    rig.up.loss = rig.down.loss = 0.05
    job = rig.begin(2000, dark_us=2400, ahead_s=1.0)
    assert rig.until(lambda: job.is_finished, inf), rig.session.board
    print(f"{rig.faults} faults")
    assert "HOLD" not in states(rig)
    assert "FAULT" not in states(rig)
    assert rig.finish() == 2000
    assert rig.faults > 20


def in_mid_job(rig, ahead_s=1.0):
    rig.session.connect()
    assert rig.armed(inf)
    job = rig.begin(3000, dark_us=900, ahead_s=ahead_s)
    assert rig.until(lambda: job.executed_count > 300, inf)
    return job


@pytest.mark.slow
def test_a_host_that_stalls_for_a_quarter_second_finishes_its_job(make_rig):
    rig = make_rig(8)
    job = in_mid_job(rig)
    time.sleep(0.25)  # the host stalls
    assert rig.until(lambda: job.is_finished, inf)
    assert "HOLD" not in states(rig)
    assert "FAULT" not in states(rig)
    assert rig.finish() == 3000


@pytest.mark.slow
def test_a_host_that_stalls_for_longer_finds_a_fault(make_rig):
    rig = make_rig(9, lease_s=1.5)
    job = in_mid_job(rig, ahead_s=3.0)
    rig.board.wait(lambda: states(rig)[-1] == "FAULT", "the end of the lease")  # the host stalls
    assert rig.board.faults() == ["LINK"]
    assert not rig.board.is_gate_on()
    assert not rig.until(lambda: job.is_finished, 0.5)
    assert states(rig)[-1] == "FAULT"
    assert rig.finish() < 3000


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


@pytest.mark.slow
def test_a_port_that_closes_at_any_moment_under_link_faults(make_rig):
    def run_fault_sessions(rig, seed):
        moments = random.Random(seed)
        for _ in range(SESSIONS):
            closing = Timer(moments.choice([moments.uniform(0.0, 2.0), moments.uniform(2.2, 3.0)]), rig.proxy.cut)
            closing.start()
            rig.live(3000, patience_s=3.0)
            closing.join()
            rig.board.wait(lambda: Path(rig.session.port).exists() and not rig.proxy.cutting, "the port's return")
        return rig.finish()

    rigs = [make_rig(seed, 0.03, extra=0.3, pauses=0.001) for seed in (11, 12)]
    with ThreadPoolExecutor(len(rigs)) as pool:
        pulses = list(pool.map(run_fault_sessions, rigs, (11, 12)))
    lost = [rig.board.states().count(("DISARMED", "link lost")) for rig in rigs]
    print(f"links lost {lost}, pulses {pulses}")
    assert sum(lost) > 0
