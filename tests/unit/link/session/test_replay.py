"""A session recorded on the simulated board and replayed into a fresh one, both in virtual time."""

import pytest
from test_session import CONFIG, Rig, plan

from optodrive.core.clock import ManualClock
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import Frame, encode_frame
from optodrive.link.protocol.transcript import Transcript
from optodrive.link.session.board_requirements import BoardRequirements
from optodrive.link.session.replay import Replay, clock_shift_s, compare_traces
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.memory_link import MemoryLink
from optodrive.link.transport.capturing_transport import CapturingTransport
from optodrive.link.transport.link_capture import (
    CLOSED,
    FROM_BOARD,
    TO_BOARD,
    CaptureEntry,
    LinkCapture,
    LinkCaptureWriter,
)

SEED = 2


class Recorded(Rig):
    """The rig of the session's tests with a tape in its line."""

    def __init__(self, path):
        super().__init__()
        self.tape = LinkCaptureWriter(path, self.clock.now_s(), pytest.fail)
        link = CapturingTransport(MemoryLink(self.core, self.clock), self.tape, self.clock)
        self.session = BoardSession(link, self.clock, BoardRequirements.from_config(CONFIG))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Armed, a plan, a reconnect that leaves the board DISARMED, armed again, a plan cut by ABORT."""
    rig = Recorded(tmp_path_factory.mktemp("tape") / "a")
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
    rig.path = rig.tape.path
    return rig


def replayed(path, seed, may_arm=True, link=MemoryLink):
    tape, log, clock = LinkCapture(path), [], ManualClock(5.0)
    replay = Replay(
        link(BoardCore(sink=log.append, seed=seed), clock), clock, clock_shift_s(tape.read_entries()), may_arm
    )
    replay.run(tape.read_entries())
    return replay, log


def stays_dark(log):
    return not any(e["event"] == "gate" or e.get("state") == "ARMED" for e in log)


def test_the_same_seed_gives_the_same_states_gate_edges_and_reports(recorded):
    replay, log = replayed(recorded.path, SEED)
    assert log == recorded.log
    verdict = compare_traces(replay.recorded, replay.replayed)
    assert verdict["identical"], verdict
    assert verdict["executed"]["recorded"] == len([e for e in recorded.log if e["event"] == "pulse"]) > 300
    assert verdict["states"]["recorded"] == verdict["states"]["replayed"]
    assert [state for state, _, _ in replay.recorded.states].count("ARMED") == 3


def test_another_seed_never_arms(recorded):
    replay, log = replayed(recorded.path, SEED + 1)
    assert stays_dark(log)
    verdict = compare_traces(replay.recorded, replay.replayed)
    assert not verdict["identical"]
    assert verdict["executed"]["missing"] == verdict["executed"]["recorded"]
    assert verdict["states"]["first_difference"] is not None


def test_a_real_board_never_hears_the_confirmation_even_if_its_nonces_repeat(recorded):
    _, log = replayed(recorded.path, SEED, may_arm=False)
    assert "ARMING" in [e["state"] for e in log if e["event"] == "state"]
    assert stays_dark(log)
    _, mutant = replayed(recorded.path, SEED, may_arm=True)
    assert not stays_dark(mutant), "the check would see a board that armed"


def test_what_is_no_frame_of_a_host_never_leaves(tmp_path):
    sent = []

    class Heard(MemoryLink):
        def write(self, data):
            sent.append(data)
            super().write(data)

    hello = encode_frame(Frame(m.Hello.TYPE, 0, 0, m.Hello(1, 0, 9).encode_body()))
    reply = encode_frame(Frame(m.Ack.TYPE, 0, 0, m.Ack(0, 0, 0, 0).encode_body()))
    path = tmp_path / "a"
    writer = LinkCaptureWriter(path, 5.0, pytest.fail)
    for entry in (
        CaptureEntry("opened", 5.0),
        CaptureEntry(TO_BOARD, 5.1, b"\x05garbage\0" + reply + hello),
        CaptureEntry(CLOSED, 5.3),
    ):
        writer.record(entry)
    writer.close()
    replayed(path, 1, link=Heard)
    assert sent == [b"\0" + hello]


def test_the_board_that_began_at_another_time_is_replayed_on_its_own_clock(tmp_path):
    """The board's counter runs 3.2 s ahead of the host's clock: START names ticks of the board's."""

    class Ahead(MemoryLink):
        def _now_us(self):
            return super()._now_us() + 3_200_000

    rig = Recorded(tmp_path / "a")
    link = CapturingTransport(Ahead(rig.core, rig.clock), rig.tape, rig.clock)
    rig.session = BoardSession(link, rig.clock, BoardRequirements.from_config(CONFIG))
    rig.connect().arm()
    job = rig.play(plan(50))
    rig.until(lambda: job.is_finished)
    rig.session.close()
    tape = LinkCapture(rig.tape.path)
    assert clock_shift_s(tape.read_entries()) == pytest.approx(3.2, abs=1e-3)
    log, clock = [], ManualClock(8.2)
    replay = Replay(
        MemoryLink(BoardCore(sink=log.append, seed=SEED), clock), clock, clock_shift_s(tape.read_entries()), True
    )
    replay.run(tape.read_entries())
    assert compare_traces(replay.recorded, replay.replayed)["identical"]
    edges = [[(e["t_us"], e["on"]) for e in events if e["event"] == "gate"] for events in (log, rig.log)]
    assert edges[0] == edges[1]
    assert len(edges[0]) == 100


@pytest.mark.parametrize("what", ["state", "width", "missing"])
def test_a_board_that_does_otherwise_is_found_out(recorded, what):
    replay, _ = replayed(recorded.path, SEED)
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


def test_the_transcript_counts_as_the_host_did(tmp_path):
    """Frames are lost on purpose; what the tape says of that is what the host's own counters say."""
    rig = Rig()
    tape = LinkCaptureWriter(tmp_path / "a", 5.0, pytest.fail)
    rig.session = BoardSession(
        CapturingTransport(rig.link, tape, rig.clock), rig.clock, BoardRequirements.from_config(CONFIG)
    )
    count = iter(range(10**9))
    rig.connect().arm()
    rig.link.keep_back = lambda frame: frame.type == m.Data.TYPE and next(count) % 5 == 2
    job = rig.play(plan(300))
    rig.until(lambda: job.is_finished)
    figures = rig.session.collect_link_stats()
    rig.session.close()
    transcript, received = Transcript(), 0
    for entry in LinkCapture(tmp_path / "a").read_entries():
        if entry.kind in (TO_BOARD, FROM_BOARD):
            received += len(transcript.feed(entry.host_s, entry.kind == TO_BOARD, entry.data))
    totals = transcript.totals
    assert totals.retransmissions == figures["retransmitted"] > 0
    assert totals.naks == figures["naks"] > 0
    assert min(totals.round_trips_s) * 1e3 == pytest.approx(figures["round_trip_ms"], rel=1e-6)
    assert totals.bad_bytes == 0
    assert received == totals.frames_to_board + totals.frames_from_board
