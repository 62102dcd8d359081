"""Likely causes of link failures, provoked on the simulated board in virtual time."""

import os
import random
import re
import subprocess
import sys
from collections import deque
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from test_session import CONFIG, Rig, plan

from optodrive.core.errors import InputError, LinkError
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol import messages as m
from optodrive.link.session.link_watch import (
    EVIDENCE_WINDOW_S,
    STALL_LEASE_FRACTION,
    LinkErrorCounts,
    LinkEvidence,
    LinkWatch,
    describe_restart,
    diagnose_lease_expiry,
    diagnose_link_loss,
    diagnose_port,
)
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.pseudo_terminal import FaultyLink
from optodrive.link.transport.port_state import PortHolder, PortState
from optodrive.link.transport.serial_port import SerialPort

LEASE_S = CONFIG.board.lease_s
QUIET = LinkEvidence("/dev/ttyACM0", PortState("available"), silent=True, lease_s=LEASE_S)


class NoisyRig(Rig):
    """Rig with a line that can flip bits in both directions."""

    def __init__(self):
        super().__init__()
        self.faults = FaultyLink(seed=1)
        self.link.write = lambda data: self.core.receive(self.faults.transmit(data), round(self.clock.now_s() * 1e6))
        read = super(type(self.link), self.link).read
        self.link.read = lambda timeout_s: self.faults.transmit(read(timeout_s))


def get_cause(rig):
    return rig.session.collect_link_stats()["likely_cause"]


def run_until_lost(rig, lease=True):
    """Run until the link is lost and return the message."""
    with pytest.raises(LinkError) as caught:
        rig.run(30.0, lease)
    message = rig.session.on_lost(caught.value)
    assert message.endswith(get_cause(rig))
    return message


def test_a_working_link_has_no_cause_and_records_its_longest_iteration():
    rig = Rig().connect().arm()
    rig.run(1.0)
    stats = rig.session.collect_link_stats()
    assert stats["likely_cause"] is None
    assert stats["likely_cause_age_s"] is None
    assert 1.9 < stats["longest_stall_ms"] < 3.0


def test_a_stalled_host_is_reported():
    rig = Rig().connect().arm()
    rig.play(plan(500))
    rig.run(0.3)
    rig.clock.sleep(0.35)
    rig.until(lambda: rig.session.board.state == "FAULT")
    assert "this computer stalled for 35" in get_cause(rig)
    assert f"the lease is {LEASE_S * 1e3:.0f} ms" in get_cause(rig)
    assert rig.session.collect_link_stats()["longest_stall_ms"] == pytest.approx(350, abs=5)


def test_a_stall_within_the_read_that_reports_it():
    rig = Rig().connect().arm()
    rig.run(0.3)
    read = rig.link.read

    def stalled_read(timeout_s):
        rig.clock.sleep(0.35)
        rig.link.read = read
        return read(timeout_s)

    rig.link.read = stalled_read
    rig.session.step(0.002, renew_lease=True)
    assert rig.session.board.fault == "LINK"
    assert "this computer stalled for 35" in get_cause(rig)


def test_an_old_stall_is_no_evidence():
    rig = Rig().connect()
    rig.clock.sleep(0.5)
    rig.run(EVIDENCE_WINDOW_S + 1.0)
    rig.arm()
    rig.until(lambda: rig.session.board.state == "FAULT", lease=False)
    assert "stalled" not in get_cause(rig)


def test_a_stalled_planner_is_reported():
    rig = Rig().connect().arm()
    rig.until(lambda: rig.session.board.state == "FAULT", lease=False)
    assert "planner made no progress" in get_cause(rig)


def test_a_reset_board_is_silent_and_then_reports_the_cause():
    for code, word in enumerate(("power-up", "reset", "brown-out", "watchdog")):
        rig = Rig().connect().arm()
        rig.core.reset(round(rig.clock.now_s() * 1e6), code)
        assert "hangs, restarts, has no power" in run_until_lost(rig)
        rig.connect()
        assert "restarted 2." in get_cause(rig)
        assert f"({word})" in get_cause(rig)


def test_a_reconnect_without_a_restart_does_not_report_one():
    rig = Rig().connect().arm()
    rig.link.cut = True
    assert "hangs, restarts, has no power" in run_until_lost(rig)
    rig.link.cut = False
    rig.connect()
    assert "restarted" not in get_cause(rig)
    assert rig.session.collect_link_stats()["likely_cause_age_s"] > 0


def test_damage_of_received_frames_is_reported_at_once():
    rig = NoisyRig().connect()
    rig.link.write = lambda data: super(type(rig.link), rig.link).write(data)
    rig.faults.inject_fault("flip_bits", 0.3)
    message = run_until_lost(rig)
    assert "bytes arrive damaged" in message
    assert "cable" in message


def test_damage_of_sent_frames_is_reported_after_the_reconnect():
    rig = NoisyRig().connect()
    rig.faults.inject_fault("flip_bits", 0.3)
    assert "receives only damaged frames" in run_until_lost(rig)
    rig.faults.repair()
    rig.connect()
    assert "reached the board damaged" in get_cause(rig)


def test_damage_of_sent_frames_lets_the_lease_expire():
    rig = NoisyRig().connect().arm()
    rig.faults.inject_fault("flip_bits", 0.04)
    rig.until(lambda: rig.session.board.state == "FAULT")
    assert rig.session.board.fault == "LINK"
    assert "bytes arrive damaged" in get_cause(rig)


def test_lost_frames_without_damage_are_reported_as_lost_bytes():
    evidence = replace(QUIET, naks=4, gaps=3, retransmitted=9)
    assert "bytes are lost on the link (9 frames retransmitted, 3 refused after a gap)" in diagnose_link_loss(evidence)
    assert diagnose_lease_expiry(evidence) == diagnose_link_loss(evidence)
    assert "was on time" in diagnose_lease_expiry(QUIET)


def test_the_port_state_has_precedence():
    missing = PortState("missing", other_ports=("/dev/ttyACM1",))
    evidence = replace(QUIET, port_state=missing, host_bad_frames=5, stall_s=9.0)
    assert diagnose_link_loss(evidence).startswith("/dev/ttyACM0 is missing")
    assert "found /dev/ttyACM1 instead" in diagnose_link_loss(evidence)
    assert "dialout" in diagnose_port("/dev/ttyACM0", PortState("denied"))
    in_use = PortState("in_use", (PortHolder(12, "ModemManager"),))
    assert "in use by ModemManager, process 12" in diagnose_link_loss(replace(QUIET, port_state=in_use))
    assert diagnose_port("/dev/ttyACM0", PortState("available")) is None
    failed = replace(QUIET, silent=False)
    assert diagnose_link_loss(replace(failed, port_fault="changed")) == "changed"
    assert "which of these is not known" in diagnose_link_loss(failed)


def test_a_stall_counts_if_it_lets_the_lease_expire():
    enough_s = STALL_LEASE_FRACTION * LEASE_S
    assert "stalled" in diagnose_lease_expiry(replace(QUIET, stall_s=enough_s))
    assert "stalled" not in diagnose_lease_expiry(replace(QUIET, stall_s=0.99 * enough_s))


def test_an_unknown_reset_cause_is_reported_as_a_number():
    assert "(unknown cause 9)" in describe_restart(9, 1.0)


def test_counters_of_an_earlier_link_are_ignored():
    watch = LinkWatch("/dev/none", LEASE_S)
    watch.on_loop(1.0, "", LinkErrorCounts(host_bad_frames=50))
    watch.on_opened()
    watch.on_loop(2.0, "", LinkErrorCounts())
    watch.on_status("LINK", 2.01, LinkErrorCounts())
    assert "was on time" in watch.cause.message
    before = watch.cause
    watch.on_status("LINK", 2.2, LinkErrorCounts(host_bad_frames=9))
    assert watch.cause is before, "explained once per fault"


def test_a_fault_from_before_the_connection_is_not_explained():
    rig = Rig().connect().arm()
    rig.until(lambda: rig.session.board.state == "FAULT", lease=False)
    rig.session.close()
    other = BoardSession(rig.link, rig.clock, build_board_requirements(CONFIG))
    other.connect()
    assert other.board.fault == "LINK"
    other.step(0.002, renew_lease=True)
    assert other.likely_cause is None


def test_an_incompatible_board_is_no_link_failure():
    rig = Rig().connect()
    message = rig.session.on_lost(InputError("board.uid", "1", "2", "board"))
    assert "likely cause" not in message
    assert get_cause(rig) is None


def test_a_removed_pty_is_missing(tmp_path):
    master, slave = os.openpty()
    name = tmp_path / "tty"
    name.symlink_to(os.ttyname(slave))
    watch = LinkWatch(str(name), LEASE_S)
    os.close(slave)
    watch.on_reconnect_failed(1.0)
    assert watch.cause is None
    device = Path(name).readlink()
    os.close(master)
    assert not device.exists()
    watch.on_reconnect_failed(2.0)
    assert watch.cause.message.startswith(f"{name} is missing")
    first = watch.cause
    watch.on_reconnect_failed(3.0)
    assert watch.cause is first
    watch.on_reconnected(4.0, 0, 100.0, LinkErrorCounts())
    assert "is available again: replugged" in watch.cause.message


def test_a_port_in_use_names_the_program(tmp_path):
    master, slave = os.openpty()
    watch = LinkWatch(os.ttyname(slave), LEASE_S)
    os.close(slave)
    code = "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", code, watch._port]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        watch.on_reconnect_failed(1.0)
        process.stdin.close()
    os.close(master)
    assert f"process {process.pid}: end that program" in watch.cause.message


@pytest.mark.parametrize(("then", "now", "counted"), [(3, 5, 2), (65_530, 4, 10), (65_535, 0, 1), (7, 7, 0)])
def test_counters_of_the_board_begin_again_after_65535(then, now, counted):
    counts = LinkErrorCounts(host_bad_frames=9, board_bad_frames=now, retransmitted=8, naks=7)
    since = counts.count_since(LinkErrorCounts(host_bad_frames=2, board_bad_frames=then, retransmitted=2, naks=2))
    assert since == LinkErrorCounts(host_bad_frames=7, board_bad_frames=counted, retransmitted=6, naks=5)


def test_a_board_that_counted_past_65535_while_it_was_silent_has_received_damaged_frames():
    rig = NoisyRig().connect()
    rig.core._link.decoder.counters.crc_errors = 65_533
    rig.run(1.0)
    rig.faults.inject_fault("flip_bits", 0.2)
    run_until_lost(rig)
    rig.faults.repair()
    rig.connect()
    assert rig.core._link.decoder.counters.crc_errors > 65_535
    assert "damaged (" in get_cause(rig)
    assert "-" not in get_cause(rig)


# --- what delays bytes, and what does not


class DelayedRig(Rig):
    """Rig whose line delays bytes in each direction by half of a random round trip of low_s to high_s."""

    def __init__(self, low_s, high_s, seed):
        super().__init__()
        link, rng = self.link, random.Random(seed)
        to_board, to_host = deque(), deque()
        send, receive = super(type(link), link).write, super(type(link), link).read

        def put(queue, data):
            arrives_s = self.clock.now_s() + 0.5 * rng.uniform(low_s, high_s)
            queue.append((max(arrives_s, queue[-1][0] if queue else 0.0), data))

        def take(queue):
            data = b""
            while queue and queue[0][0] <= self.clock.now_s():
                data += queue.popleft()[1]
            return data

        def read(timeout_s):
            send(take(to_board))
            data = receive(min(timeout_s, 0.001))
            if data:
                put(to_host, data)
            return take(to_host)

        link.write, link.read = partial(put, to_board), read


@pytest.mark.parametrize(("low_s", "high_s"), [(0.1, 0.1), (0.18, 0.18), (0.1, 0.18), (0.0, 0.25)])
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_long_round_trip_is_reported_as_delay_and_nobody_is_blamed(low_s, high_s, seed):
    rig = DelayedRig(low_s, high_s, seed).connect()
    rig.session.arm()
    rig.until(lambda: rig.session.board.fault == "LINK")
    rig.run(0.2)
    assert re.match(r"the link delays bytes: answers take up to \d+ ms", get_cause(rig))
    assert "lost" not in get_cause(rig).replace("no byte is known to be lost", "")


@pytest.mark.parametrize("leases", [0.1, 0.5])
def test_a_process_that_withheld_the_lease_for_an_instant_is_not_blamed(leases):
    rig = Rig().connect().arm()
    until_s = rig.clock.now_s() + leases * LEASE_S
    while rig.clock.now_s() < until_s:
        rig.session.step(0.002, renew_lease=False, stalled="web")
    rig.run(0.5 * LEASE_S)
    rig.link.drop_frame = lambda frame: frame.type == m.Lease.TYPE
    rig.until(lambda: rig.session.board.state == "FAULT")
    assert "bytes were delayed on the link" in get_cause(rig)


def test_a_web_process_that_withheld_the_lease_is_blamed():
    rig = Rig().connect().arm()
    while rig.session.board.state != "FAULT":
        rig.session.step(0.002, renew_lease=False, stalled="web")
    assert "the web process did not respond" in get_cause(rig)


def test_a_frame_that_was_sent_again_is_neither_lost_nor_late_for_certain():
    assert "lost or late, which of the two is not known" in diagnose_link_loss(replace(QUIET, retransmitted=4))
    refused = replace(QUIET, naks=3)  # of commands, and no sign of lost bytes
    assert diagnose_link_loss(refused) == diagnose_link_loss(QUIET)


@pytest.mark.parametrize(
    ("change", "named"), [(["9600"], "bit rate"), (["icanon", "echo"], "line mode"), (["sane"], "line mode")]
)
def test_stty_on_the_open_port_is_named(change, named):
    master, slave = os.openpty()
    port = SerialPort(os.ttyname(slave), 1_000_000)
    port.open()
    watch = LinkWatch(port.name, LEASE_S, describe_fault=port.describe_fault)
    assert port.describe_fault() == ""
    os.close(slave)
    subprocess.run(["stty", "-F", port.name, *change], check=True)
    for silent in (True, False):
        cause = watch.on_lost(1.0, 0.0, silent).message
        assert "another program changed the settings" in cause
        assert named in cause
    watch.on_loop(1.0, "", LinkErrorCounts())
    watch.on_status("LINK", 1.01, LinkErrorCounts())
    assert "another program changed the settings" in watch.cause.message
    port.close()
    port.open()
    assert port.describe_fault() == ""
    port.close()
    os.close(master)
