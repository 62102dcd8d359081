"""Replay of a capture of the simulated board to another simulated board, in virtual time."""

import pytest
from test_session import CONFIG, Rig, plan

from optodrive.core.clock import ManualClock
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import Frame, encode_frame
from optodrive.link.protocol.transcript import Transcript
from optodrive.link.session.replay import Replay, clock_shift_s, compare_traces
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.virtual_run import MemoryLink
from optodrive.link.transport.link_capture import (
    CLOSED,
    FROM_BOARD,
    TO_BOARD,
    CaptureEntry,
    CapturingTransport,
    LinkCapture,
    LinkCaptureWriter,
)

SEED = 2


class CapturedRig(Rig):
    """Rig of the session tests with a link capture."""

    def __init__(self, path):
        super().__init__()
        self.capture = LinkCaptureWriter(path, self.clock.now_s(), pytest.fail)
        link = CapturingTransport(MemoryLink(self.core, self.clock), self.capture, self.clock)
        self.session = BoardSession(link, self.clock, build_board_requirements(CONFIG))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Capture of a plan, a reconnect to DISARMED, and a plan that ABORT ends."""
    rig = CapturedRig(tmp_path_factory.mktemp("capture") / "capture")
    rig.connect().arm()
    job = rig.play(plan(300))
    rig.until(lambda: job.is_finished)
    rig.session.disconnect()
    rig.clock.sleep(0.3)
    rig.connect().arm()
    rig.play(plan(200))
    rig.run(0.3)
    rig.session.abort()
    rig.run(0.2)
    rig.session.close()
    rig.path = rig.capture.path
    return rig


def replay_capture(path, seed, may_arm=True, link=MemoryLink):
    capture, log, clock = LinkCapture(path), [], ManualClock(5.0)
    replay = Replay(
        link(BoardCore(sink=log.append, seed=seed), clock), clock, clock_shift_s(capture.read_entries()), may_arm
    )
    replay.run(capture.read_entries())
    return replay, log


def stays_off(log):
    return not any(e["event"] == "gate" or e.get("state") == "ARMED" for e in log)


def test_the_same_seed_gives_the_same_states_gate_edges_and_reports(recorded):
    replay, log = replay_capture(recorded.path, SEED)
    assert log == recorded.log
    verdict = compare_traces(replay.recorded, replay.replayed)
    assert verdict["identical"], verdict
    assert verdict["executed"]["recorded"] == len([e for e in recorded.log if e["event"] == "pulse"]) > 300
    assert verdict["states"]["recorded"] == verdict["states"]["replayed"]
    assert [state for state, _, _ in replay.recorded.states].count("ARMED") == 3


def test_another_seed_never_arms(recorded):
    replay, log = replay_capture(recorded.path, SEED + 1)
    assert stays_off(log)
    verdict = compare_traces(replay.recorded, replay.replayed)
    assert not verdict["identical"]
    assert verdict["executed"]["missing"] == verdict["executed"]["recorded"]
    assert verdict["states"]["first_difference"] is not None


def test_a_real_board_never_receives_the_confirmation(recorded):
    _, log = replay_capture(recorded.path, SEED, may_arm=False)
    assert "ARMING" in [e["state"] for e in log if e["event"] == "state"]
    assert stays_off(log)
    _, mutant = replay_capture(recorded.path, SEED, may_arm=True)
    assert not stays_off(mutant), "the check detects a board that armed"


def test_only_frames_of_a_host_are_sent(tmp_path):
    sent = []

    class RecordingLink(MemoryLink):
        def write(self, data):
            sent.append(data)
            super().write(data)

    hello = encode_frame(Frame(m.Hello.TYPE, 0, 0, m.Hello(1, 0, 9).encode_body()))
    reply = encode_frame(Frame(m.Ack.TYPE, 0, 0, m.Ack(0, 0, 0, 0).encode_body()))
    path = tmp_path / "capture"
    writer = LinkCaptureWriter(path, 5.0, pytest.fail)
    for entry in (
        CaptureEntry("opened", 5.0),
        CaptureEntry(TO_BOARD, 5.1, b"\x05garbage\0" + reply + hello),
        CaptureEntry(CLOSED, 5.3),
    ):
        writer.record(entry)
    writer.close()
    replay_capture(path, 1, link=RecordingLink)
    assert b"".join(sent) == b"\0" + hello


def test_a_hello_that_a_late_port_loses_is_repeated(recorded):
    class LateLink(MemoryLink):
        is_late = True

        def write(self, data):
            if data and self.is_late:
                self.is_late = False
            else:
                super().write(data)

    replay, log = replay_capture(recorded.path, SEED, may_arm=False, link=LateLink)
    assert replay.replayed.sessions == replay.recorded.sessions
    assert stays_off(log)


def test_a_replay_follows_the_captured_clock_offset(tmp_path):
    """The captured board clock is 3.2 s ahead of the host, and START refers to board ticks."""

    class Ahead(MemoryLink):
        def _now_us(self):
            return super()._now_us() + 3_200_000

    rig = CapturedRig(tmp_path / "capture")
    link = CapturingTransport(Ahead(rig.core, rig.clock), rig.capture, rig.clock)
    rig.session = BoardSession(link, rig.clock, build_board_requirements(CONFIG))
    rig.connect().arm()
    job = rig.play(plan(50))
    rig.until(lambda: job.is_finished)
    rig.session.close()
    capture = LinkCapture(rig.capture.path)
    assert clock_shift_s(capture.read_entries()) == pytest.approx(3.2, abs=1e-3)
    log, clock = [], ManualClock(8.2)
    replay = Replay(
        MemoryLink(BoardCore(sink=log.append, seed=SEED), clock), clock, clock_shift_s(capture.read_entries()), True
    )
    replay.run(capture.read_entries())
    assert compare_traces(replay.recorded, replay.replayed)["identical"]
    edges = [[(e["t_us"], e["on"]) for e in events if e["event"] == "gate"] for events in (log, rig.log)]
    assert edges[0] == edges[1]
    assert len(edges[0]) == 100


@pytest.mark.parametrize("what", ["state", "width", "missing"])
def test_a_different_behaviour_is_detected(recorded, what):
    replay, _ = replay_capture(recorded.path, SEED)
    if what == "state":
        replay.replayed.states[3] = ("FAULT", "LINK", "fault")
    elif what == "width":
        key = next(iter(replay.replayed.executed))
        tick, on, duty = replay.replayed.executed[key]
        replay.replayed.executed[key] = tick, on + 1, duty
    else:
        replay.replayed.executed.popitem()
    verdict = compare_traces(replay.recorded, replay.replayed)
    assert not verdict["identical"]
    assert verdict["states"]["first_difference"] == (3 if what == "state" else None)
    assert (verdict["executed"]["changed"], verdict["executed"]["missing"]) == (what == "width", what == "missing")


def test_the_transcript_counts_agree_with_the_host(tmp_path):
    """With dropped frames, the counts from the capture equal those of the host."""
    rig = Rig()
    capture = LinkCaptureWriter(tmp_path / "capture", 5.0, pytest.fail)
    rig.session = BoardSession(
        CapturingTransport(rig.link, capture, rig.clock), rig.clock, build_board_requirements(CONFIG)
    )
    count = iter(range(10**9))
    rig.connect().arm()
    rig.link.drop_frame = lambda frame: frame.type == m.Data.TYPE and next(count) % 5 == 2
    job = rig.play(plan(300))
    rig.until(lambda: job.is_finished)
    stats = rig.session.collect_link_stats()
    rig.session.close()
    transcript, received = Transcript(), 0
    for entry in LinkCapture(tmp_path / "capture").read_entries():
        if entry.kind in (TO_BOARD, FROM_BOARD):
            received += len(transcript.feed(entry.host_s, entry.kind == TO_BOARD, entry.data))
    totals = transcript.totals
    assert totals.retransmissions == stats["retransmitted"] > 0
    assert totals.naks == stats["naks"] > 0
    assert min(totals.round_trips_s) * 1e3 == pytest.approx(stats["round_trip_ms"], rel=1e-6)
    assert totals.bad_bytes == 0
    assert received == totals.frames_to_board + totals.frames_from_board
