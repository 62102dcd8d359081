"""Scenarios of the link: handshake, versions, sessions, go-back-N, NAKs, clock, status."""

from bench import BRIGHT, PATIENT, WITH_THE_END, act, here
from scenario import scenario
from wire_format import HOST, body_of, frame

UID = "00112233445566778899aabb"


# --- handshake and versions -----------------------------------------------------------------------------------------


@scenario("handshake")
def board_without_a_session_answers_only_hello(bench):
    host = bench.host(bench.board(**PATIENT))
    host.board.wait(lambda: host.board.of("port"), "the port to be seen")
    for name, fields in (("GET", {}), ("CLOCK", {"host_t": 1}), ("ARM_REQ", {"host_nonce": 1}), ("ABORT", {})):
        host.send(name, **fields)
    host.pause(0.3)
    assert host.received == []
    assert [entry["state"] for entry in host.board.of("state")] == ["DISARMED"]
    assert host.hello().reset_cause == 0


def _any_limits():
    return dict.fromkeys(HOST["LIMITS"][2], 1)


@scenario("handshake")
def hello_reply_describes_the_board(bench):
    host = bench.host(bench.board(uid=UID, cell_codes=900, queue_points=100, key_edge=True, max_on_us=1234, y_min=77))
    reply = host.hello()
    assert (reply.major, reply.tick_hz) == (1, 1_000_000)
    assert (reply.uid.hex(), reply.cell_codes, reply.queue_points) == (UID, 900, 100)
    assert (reply.capabilities & 1, reply.max_on_us, reply.y_min) == (1, 1234, 77)
    assert reply.session != 0


@scenario("handshake")
def hello_is_accepted_in_any_session_and_ends_the_job(bench):
    host = bench.ready(**BRIGHT)
    host.shine()
    host.raw(frame(HOST["HELLO"][0], 5, host.session ^ 0x5555, body_of("HELLO", major=1, minor=9, host_nonce=7777)))
    host.wait(lambda: host.of("HELLO_REPLY")[-1].host_nonce == 7777, "the reply")
    assert host.of("HELLO_REPLY")[-1].session != host.session
    host.session, host.seq = host.of("HELLO_REPLY")[-1].session, 0
    assert host.board.states()[-1] == ("DISARMED", "hello")
    status = host.status()
    assert (status.state, status.queued, status.done_index) == ("DISARMED", 0, 0)
    host.arm()
    assert host.order(host.frame("DATA", first_index=0, points=[here(0)])) == [], "numbers begin again"


@scenario("versions")
def other_major_version_gets_a_reply_but_cannot_arm(bench):
    host = bench.host(bench.board(key_edge=True, **PATIENT))
    reply = host.hello(major=2)
    assert reply.major == 1
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["VERSION"]
    assert host.status().state == "DISARMED"
    host.hello()
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["KEY_EDGE"]


@scenario("handshake")
def reset_clears_all_state_and_hello_reports_it(bench):
    host = bench.ready(act("reset"), **BRIGHT)
    host.play(here(100))
    host.wait_for_change("job done")
    host.board.next_step()
    host.board.wait(lambda: len(host.board.changes("boot")) == 2, "the reset")
    assert_no_session(host)
    assert host.hello().reset_cause == 1
    status = host.status()
    assert (status.state, status.done_index, status.queued) == ("DISARMED", 0, 0)
    assert host.send_checked("ARM_REQ", host_nonce=1) == []
    event, logged = host.of("EVENT")[-1], host.board.of("state")[-1]
    assert event.reason == logged["reason"] == "arm requested"
    assert event.tick == logged["t_us"] - host.board.changes("boot")[-1]["t_us"], "the clock starts again"


def assert_no_session(host):
    """Assert that a board that was reset does not answer, however late its earlier messages arrive."""
    count = len(host.of("STATUS"))
    host.send("GET")
    host.pause(0.2, lease=False)
    assert len(host.of("STATUS")) == count, "a session that outlived the reset"


# --- sessions -------------------------------------------------------------------------------------------------------


@scenario("sessions")
def frames_of_other_sessions_or_from_a_board_have_no_effect(bench):
    host = bench.ready(**PATIENT)
    before = host.status()
    foreign = [host.frame(name, seq=host.seq, session=host.session ^ 1) for name in ("DISARM", "FLUSH", "GET")]
    foreign += [host.frame("DISARM", seq=host.seq, session=0)]
    ack = frame(0x90, 0, host.session, bytes(8))
    answers, after = host.request(b"".join(foreign) + ack)
    assert answers == []
    assert after.seq_errors == before.seq_errors + 5
    assert (after.state, after.crc_errors, after.format_errors) == ("ARMED", before.crc_errors, before.format_errors)


@scenario("sessions")
def abort_is_accepted_in_any_session(bench):
    host = bench.ready(**BRIGHT)
    host.shine()
    host.request(host.frame("ABORT", seq=200, session=host.session ^ 0x1234))
    assert host.board.states()[-1] == ("DISARMED", "abort")
    status = host.status()
    assert (status.state, status.queued) == ("DISARMED", 0)


@scenario("sessions")
def reopened_port_is_not_armed(bench):
    host = bench.ready(**BRIGHT)
    host.shine()
    host.close()
    host.board.wait(lambda: host.board.states()[-1] == ("DISARMED", "link lost"), "the loss")
    count = len(host.board.pulse_numbers())
    again = bench.host(host.board)
    assert again.hello().session != host.session
    assert again.status().state == "DISARMED"
    again.arm()
    assert again.status().queued == 0
    assert again.play(here(1000), here(0), here(1000)) == []
    again.wait(lambda: host.board.states()[-1] == ("ARMED", "job done"), "the job")
    assert host.board.pulse_numbers()[count:] == [0, 2], "nothing of the old job is left"
    assert [entry["open"] for entry in host.board.of("port")] == [True, False, True]


# --- go-back-N ------------------------------------------------------------------------------------------------------


@scenario("go-back-N")
def gap_is_refused_at_once_and_filled_in_order(bench):
    host = bench.ready(**PATIENT)
    first, second, third = (host.data(here(0, dark_us=k)) for k in range(3))
    before = host.status().seq_errors
    answers, status = host.request(second + third)
    assert {(m.name, m.reason, m.next_seq) for m in answers} == {("NAK", "SEQUENCE", (host.seq - 3) % 256)}
    assert (status.queued, status.seq_errors) == (0, before + 2)
    answers, status = host.request(first + second + third)
    assert {m.name for m in answers} == {"ACK"}
    assert answers[-1].next_seq == host.seq
    assert status.queued == 3


@scenario("go-back-N")
def duplicate_frame_is_answered_but_not_executed(bench):
    host = bench.ready(queue_points=1000, **PATIENT)
    taken = host.data(here(0))
    assert host.order(taken) == []
    answers, status = host.request(taken)
    assert [(m.name, m.next_seq, m.free_points) for m in answers] == [("ACK", host.seq, 1000 - 1)]
    assert status.queued == 1
    refused = host.frame("START", job=1, first_index=9, start_tick=0, watermark=1)
    for _ in range(3):
        answers, status = host.request(refused)
        assert [(m.name, m.reason, m.next_seq) for m in answers] == [("NAK", "INDEX", host.seq)]
    assert status.state == "ARMED"


@scenario("go-back-N")
def sequence_numbers_ahead_and_behind_divide_at_half(bench):
    host = bench.greeted(**PATIENT)
    assert host.send_checked("DISARM") == []
    before = host.status().seq_errors
    for distance, name in ((1, "NAK"), (127, "NAK"), (128, "ACK"), (255, "ACK")):
        answers, status = host.request(host.frame("CLEAR_FAULT", seq=(host.seq + distance) % 256))
        assert [(m.name, m.next_seq) for m in answers] == [(name, host.seq)], distance
    assert status.seq_errors == before + 2
    assert status.state == "DISARMED"


@scenario("go-back-N")
def sequence_numbers_wrap_at_256_and_restart_at_hello(bench):
    host = bench.greeted(**PATIENT)
    assert host.order(*[host.frame("DISARM") for _ in range(270)]) == []
    answers, _ = host.request(host.frame("DISARM"))
    assert answers[-1].next_seq == 271 % 256
    host.hello()
    answers, _ = host.request(host.frame("DISARM"))
    assert answers[-1].next_seq == 1


@scenario("NAK")
def message_in_a_wrong_state_is_refused_with_its_reason(bench):
    host = bench.greeted(**PATIENT)
    start = dict(job=1, first_index=0, start_tick=0, watermark=1)
    assert host.order(host.frame("DATA", first_index=0, points=[here(0)])) == ["STATE"]
    assert host.send_checked("START", **start) == ["STATE"]
    assert host.send_checked("END", job=1, end_index=0) == ["STATE"]
    assert host.send_checked("FLUSH") == ["STATE"]
    assert host.send_checked("CLEAR_FAULT") == ["STATE"]
    assert host.send_checked("ARM_CONFIRM", host_nonce=1, board_nonce=1) == ["STATE"]
    assert host.send_checked("DISARM") == []
    host.arm()
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["STATE"]
    assert host.send_checked("ARM_CONFIRM", host_nonce=1, board_nonce=1) == ["STATE"]
    assert host.send_checked("CLEAR_FAULT") == ["STATE"]
    assert host.send_checked("LIMITS", **_any_limits()) == ["STATE"]
    assert host.send_checked("START", **{**start, "first_index": 1}) == ["INDEX"]
    assert host.send_checked("END", job=1, end_index=0) == ["STATE"]
    assert host.status().state == "ARMED"


@scenario("NAK")
def refusal_within_a_batch_does_not_stop_the_rest(bench):
    host = bench.ready(**BRIGHT)
    start = dict(job=1, start_tick=0, watermark=1)
    frames = [
        host.data(here(100), here(100)),
        host.frame("START", first_index=7, **start),
        host.frame("START", first_index=0, **start),
        host.frame("END", job=1, end_index=2),
    ]
    answers, _ = host.request(b"".join(frames))
    answers = [m for m in answers if m.name in ("ACK", "NAK")]
    assert [(m.reason, m.next_seq) for m in answers if m.name == "NAK"] == [("INDEX", (host.seq - 2) % 256)]
    assert (answers[-1].name, answers[-1].next_seq) == ("ACK", host.seq)
    host.wait(lambda: host.board.states()[-1] == ("ARMED", "job done"), "the job")
    assert host.board.pulse_numbers() == [0, 1]


@scenario("NAK")
def batch_is_executed_in_order(bench):
    host = bench.ready(**BRIGHT)
    frames = [host.data(*[here(1000)] * 24) for _ in range(4)]
    frames += [host.frame("START", job=1, first_index=0, start_tick=0, watermark=1)]
    frames += [host.frame("END", job=1, end_index=96), host.frame("FLUSH"), host.frame("DISARM")]
    answers, _ = host.request(b"".join(frames))
    assert "NAK" not in {m.name for m in answers}
    ack = [m for m in answers if m.name == "ACK"][-1]
    assert (ack.next_seq, ack.done_index, ack.state) == (host.seq, 96, "DISARMED")
    assert host.board.states()[-3:] == [("RUNNING", "start"), ("ARMED", "flush"), ("DISARMED", "disarm")]


# --- clock and status -----------------------------------------------------------------------------------------------


@scenario("clock")
def tick_is_a_microsecond_and_host_t_is_returned(bench):
    host = bench.greeted(**PATIENT)
    requested = []
    for stamp in (0, 0xFFFF_FFFF, 0x0100_0001):
        sent_s = host.clock.now_s()
        host.send("CLOCK", host_t=stamp)
        host.wait(lambda: host.of("CLOCK_REPLY"), "the clock", lease=False)
        heard_s = host.clock.now_s()
        (reply,) = host.of("CLOCK_REPLY")
        assert reply.host_t == stamp
        host.received.clear()
        requested.append((sent_s, reply.tick, heard_s))
        host.pause(0.3, lease=False)
    (sent_s, first, heard_s), _, (later_sent_s, last, later_heard_s) = requested
    passed_s = (last - first) * 1e-6
    assert (later_sent_s - heard_s) * 0.999 - 0.001 <= passed_s <= (later_heard_s - sent_s) * 1.001 + 0.001


@scenario("status")
def status_and_events_agree_with_the_log(bench):
    host = bench.ready(**BRIGHT)
    points = here(10_000, duty=65535), here(10_000, dark_us=50, duty=32768), here(0, dark_us=100, duty=0)
    host.play(*points, watermark=WITH_THE_END)
    host.wait(lambda: host.board.states()[-1] == ("ARMED", "job done"), "the job")
    status = host.status()
    assert (status.state, status.fault, status.inputs, status.queued, status.underruns) == ("ARMED", "", 0b011, 0, 0)
    assert status.done_index == 3
    assert abs(status.laser_on_us - 15_000) <= 1
    host.send("ABORT")
    host.wait(lambda: host.board.states()[-1][1] == "abort" and host.status().state == "DISARMED", "the abort")
    reported = [(m.state, m.reason, m.tick) for m in host.of("EVENT")]
    logged = [(entry["state"], entry["reason"], entry["t_us"]) for entry in host.board.of("state")][1:]
    assert [event[:2] for event in reported] == [event[:2] for event in logged]
    assert len({logged_us - tick for (*_, tick), (*_, logged_us) in zip(reported, logged, strict=True)}) == 1


@scenario("credits")
def points_without_room_are_refused_and_can_be_resent(bench):
    host = bench.ready(queue_points=30, **BRIGHT)
    assert host.order(host.data(*[here(0, dark_us=60_000)] * 24)) == []
    assert host.of("ACK")[-1].free_points == 6
    over = host.data(*[here(0, dark_us=100)] * 7)
    answers, status = host.request(over)
    assert [(m.name, m.reason, m.next_seq) for m in answers] == [("NAK", "NO_ROOM", (host.seq - 1) % 256)]
    assert status.queued == 24
    assert host.order(host.frame("END", seq=host.seq, job=1, end_index=24)) == ["SEQUENCE"], "it waits for the frame"
    host.seq, host.index = (host.seq - 1) % 256, 24  # the frame was not consumed
    assert host.send_checked("START", job=1, first_index=0, start_tick=0, watermark=1) == []
    host.wait(lambda: host.status().queued <= 20, "room")
    assert host.order(host.data(*[here(0, dark_us=100)] * 7)) == []
    assert host.send_checked("END", job=1, end_index=31) == []
    host.wait(lambda: host.board.states()[-1] == ("ARMED", "job done"), "the job")
    assert host.status().done_index == 31
