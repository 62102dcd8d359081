"""Scenarios of B1 to B8: time, position, duration and power of emission."""

from bench import BRIGHT, CENTRE, PATIENT, act, here, set_input
from scenario import scenario
from wire_format import HOST, body_of, frame

OTHER_CELL = CENTRE + 2000
INSTANT = dict(settle_us=0, settle_ns_per_code=0)


def wait_for_log(host, condition, what):
    """Wait for the board's log. Send only leases."""
    host.wait(lambda: condition(host.board), what)


# --- B1 -------------------------------------------------------------------------------------------------------------


@scenario("B1")
def gate_is_off_until_the_first_point_is_due(bench):
    host = bench.ready(**BRIGHT)
    host.order(host.data(here(1000)))
    host.pause(0.05)
    assert host.board.of("gate") == [], "lit in ARMED"
    start = host.status().tick + 2_000_000
    assert host.order(host.frame("START", job=1, first_index=0, start_tick=start, watermark=1)) == []
    wait_for_log(host, lambda board: board.pulse_numbers(), "the pulse")
    host.status()
    (pulse,) = host.board.of("pulse")
    (event,) = [m for m in host.of("EVENT") if m.reason == "start"]
    (started,) = host.board.changes("start")
    assert host.board.of("gate")[0]["t_us"] == pulse["on_us"], "lit before its point"
    assert event.tick < start, "the host was late"
    on_tick = pulse["on_us"] - (started["t_us"] - event.tick)
    assert 0 <= on_tick - start <= host.board.late_us


ENDS = {
    "flush": ("flush", lambda host: host.send("FLUSH")),
    "disarm": ("disarm", lambda host: host.send("DISARM")),
    "abort": ("abort", lambda host: host.send("ABORT")),
    "hello": ("hello", lambda host: host.send("HELLO", major=1, minor=0, host_nonce=77)),
    "closed port": ("link lost", lambda host: host.close()),
}


@scenario("B1", ENDS)
def leaving_running_turns_the_gate_off_first(bench, end):
    reason, leave = end
    host = bench.ready(**BRIGHT)
    board = host.board
    host.shine()
    leave(host)
    board.wait(lambda: board.changes(reason), f"the end by {reason}")
    assert board.states()[-2][0] == "RUNNING"
    assert is_off_by(board, board.of("state")[-1])


@scenario("B1", {"an input": (set_input("interlock", False), "fault"), "a reset": (act("reset"), "boot")})
def external_event_turns_the_gate_off_at_once(bench, case):
    step, reason = case
    host = bench.ready(step, **BRIGHT)
    host.shine()
    host.board.next_step()
    wait_for_log(host, lambda board: len(board.states()) > 4, "the end")
    assert host.board.states()[-1][1] == reason
    assert is_off_by(host.board, host.board.of("state")[-1])


def is_off_by(board, change):
    """Return whether the last edge is off and not after a change of state."""
    edge = board.of("gate")[-1]
    events = board.events()
    return not edge["on"] and edge["t_us"] <= change["t_us"] and events.index(edge) < events.index(change)


# --- B2 -------------------------------------------------------------------------------------------------------------


@scenario("B2")
def gate_turns_off_in_time_with_and_without_more_points(bench):
    host = bench.ready(**BRIGHT)
    host.play(here(10_000), here(500, dark_us=20_000), end=False)
    hold = host.wait_for_change("queue empty")
    edges = [(entry["t_us"], entry["on"]) for entry in host.board.of("gate")]
    assert [on for _, on in edges] == [True, False, True, False]
    for (on_us, _), (off_us, _), width_us in zip(edges[::2], edges[1::2], (10_000, 500), strict=True):
        assert 0 <= off_us - on_us - width_us <= min(100, host.board.late_us)
    assert 0 <= hold["t_us"] - edges[-1][0] <= host.board.late_us
    assert host.status().underruns == 1


# --- B3 -------------------------------------------------------------------------------------------------------------

LEASE_MS = 3000
PULSES = {"ARMING": 0, "ARMED": 0, "RUNNING": 80, "HOLD": 45}
"""Pulses of 50 ms that the board plays from the last lease on; a HOLD lasts a second at most."""


@scenario("B3", {state: state for state in PULSES})
def only_a_lease_of_this_session_prevents_fault_link(bench, state):
    host = bench.greeted(**{**BRIGHT, "lease_ms": LEASE_MS})
    if state == "ARMING":
        host.challenge()
    else:
        host.arm()
    points = [here(50_000, duty=2000)] * PULSES[state]
    pieces = [host.data(*points[at : at + 20]) for at in range(0, len(points), 20)]
    start = [host.frame("START", job=1, first_index=0, start_tick=0, watermark=1)] * bool(points)
    # Both ticks bracket the lease; the maximum applies, and a shorter lease does not shorten it. The first is that of
    # STATUS: a simulated board that ran late takes bytes as of the time before, but tells the present one to CLOCK.
    before = host.status().tick
    leases = host.frame("LEASE", ms=60_000) + host.frame("LEASE", ms=1) + host.frame("CLOCK", host_t=1)
    host.raw(b"".join(pieces + start) + leases)
    useless = b"".join(
        [
            host.frame("LEASE", ms=60_000, session=host.session ^ 1),
            host.frame("LEASE", ms=60_000, session=0),
            host.frame("LEASE", ms=60_000)[:-3] + b"\0",
            frame(HOST["LEASE"][0] | 0x80, 0, host.session, body_of("LEASE", ms=60_000)),
            host.frame("GET"),
            host.frame("CLOCK", host_t=2),
            host.frame("DATA", seq=(host.seq + 9) % 256, first_index=0, points=[here(1)]),
        ]
    )
    host.status()
    (after,) = [m.tick for m in host.of("CLOCK_REPLY")]
    while (status := host.status()).state != "FAULT":
        assert status.tick <= after + LEASE_MS * 1000 + host.board.late_us, f"{state}: no fault without a lease"
        host.raw(useless)
        host.pause(0.02, lease=False)
    (fault,) = [m for m in host.of("EVENT") if m.state == "FAULT"]
    assert fault.fault == "LINK"
    assert host.board.of("state")[-1]["before"] == state
    assert before + LEASE_MS * 1000 <= fault.tick <= after + LEASE_MS * 1000 + host.board.late_us
    host.send("LEASE", ms=LEASE_MS)
    assert host.status().state == "FAULT"
    assert not host.board.is_gate_on()


# --- B4 -------------------------------------------------------------------------------------------------------------

SPLITS = {
    "the same place": [here(30_000), here(20_001)],
    "the same cell": [here(30_000), here(20_001, x=CENTRE + 300)],
    "a border between": [here(30_000, x=CENTRE + 649), here(20_001, x=CENTRE + 650)],
    "a corner between": [here(30_000, x=CENTRE + 649, y=CENTRE - 651), here(20_001, x=CENTRE + 650, y=CENTRE - 650)],
    "no rest between": [here(30_000), here(20_001, dark_us=499)],
    "hardly any power": [here(25_000, duty=655), here(25_001, duty=655)],
}


@scenario("B4")
def point_above_max_on_us_is_refused_when_queued(bench):
    host = bench.ready(**PATIENT)
    assert host.order(host.data(here(50_000)), host.data(here(50_001, duty=0))) == ["STATE"]
    assert host.board.faults() == ["ON_TIME"]


@scenario("B4", SPLITS)
def split_pulses_in_a_cell_add_up(bench, points):
    host = bench.ready(**PATIENT)
    host.play(*points)
    wait_for_log(
        host, lambda board: board.states()[-1][0] in ("FAULT", "ARMED") and len(board.pulse_numbers()) >= 1, "the end"
    )
    assert host.board.faults() == ["ON_TIME"]
    assert host.board.pulse_numbers() == [0]


@scenario("B4")
def only_a_full_rest_clears_the_on_time(bench):
    host = bench.ready(settle_us=100, settle_ns_per_code=0, **PATIENT)
    dim = dict(duty=999)
    rest = here(0, dark_us=500)
    host.play(here(30_000, **dim), here(20_000, **dim), rest, here(50_000, **dim))
    wait_for_log(host, lambda board: board.states()[-1] == ("ARMED", "job done"), "the job")
    assert len(host.board.pulse_numbers()) == 3, "50 ms in two pieces, and again after 500 µs of rest"
    host.play(here(0, dark_us=600), here(30_000, **dim), here(100, x=OTHER_CELL), here(30_000, **dim))
    wait_for_log(host, lambda board: board.of("fault") or len(board.pulse_numbers()) == 6, "the fault")
    assert host.board.faults() == ["ON_TIME"]
    assert len(host.board.pulse_numbers()) == 5


@scenario("B4")
def interrupted_pulse_counts_in_full(bench):
    host = bench.ready(rest_us=60_000, **PATIENT)
    host.play(here(40_000, duty=100))
    host.wait(host.board.is_gate_on, "light")
    assert host.send_checked("FLUSH") == []
    host.play(here(20_000, duty=100))
    wait_for_log(host, lambda board: board.states()[-1][1] in ("fault", "job done"), "the end")
    (pulse,), (_, second) = host.board.of("pulse")[:1], host.board.changes("start")
    has_rested = second["t_us"] >= pulse["on_us"] + 40_000 + 60_000
    assert host.board.faults() == ["ON_TIME"] * (not has_rested)


# --- B5 -------------------------------------------------------------------------------------------------------------


def sweep(count, on_us=20_000):
    """Return pulses in separate cells."""
    return [here(on_us, x=1000 + 2000 * k) for k in range(count)]


@scenario("B5")
def point_above_max_duty_is_refused_when_queued(bench):
    host = bench.ready(max_duty=40_000, **PATIENT)
    assert host.order(host.data(here(0, duty=40_000)), host.data(here(0, duty=40_001))) == ["STATE"]
    assert host.board.faults() == ["DUTY"]


@scenario("B5", {"just too much": (6553, 4), "just enough": (6554, 5)})
def mean_power_over_any_second(bench, case):
    mean_duty, allowed = case
    host = bench.ready(mean_duty=mean_duty, **INSTANT, **PATIENT)
    old = [here(0, dark_us=60_000, duty=0)] * 15
    more = [*old, *sweep(5), here(100, dark_us=60_000)] if allowed == 5 else []
    host.play(*sweep(5), *more)
    wait_for_log(host, lambda board: board.of("fault"), "the fault")
    assert host.board.faults() == ["MEAN_POWER"]
    # Five pulses of 20 ms at full power are 6554 in a second; pulses older than a second do not count.
    assert len(host.board.pulse_numbers()) == (10 if allowed == 5 else 4)


@scenario("B5")
def more_pulses_in_a_second_than_the_board_remembers(bench):
    host = bench.host(bench.board(window_pulses=8, **INSTANT, **PATIENT))
    assert host.hello().window_pulses == 8
    host.arm()
    host.play(*[here(100, dark_us=1000, duty=99)] * 8, *[here(0, dark_us=60_000)] * 17, *[here(100, duty=99)] * 9)
    wait_for_log(host, lambda board: board.of("fault"), "the fault")
    assert host.board.faults() == ["PULSES"]
    assert len(host.board.pulse_numbers()) == 16


# --- B6 -------------------------------------------------------------------------------------------------------------

BUCKETS = {
    "too soon": ([here(45_000), here(45_000, dark_us=1000)], "SPOT", 1),
    "across a border": ([here(45_000, x=CENTRE + 649), here(45_000, dark_us=1000, x=CENTRE + 650)], "SPOT", 1),
    "another cell": (
        [here(45_000), here(45_000, dark_us=1000, x=OTHER_CELL), here(45_000, dark_us=1000)],
        "",
        3,
    ),  # 110.25 mJ each of 150, and 1.4 W leak
    "more than leaks": ([here(15_000, dark_us=5000)] * 24, "SPOT", 13),
    "less than leaks": ([here(10_000, dark_us=9000)] * 24, "", 24),
}


@scenario("B6", BUCKETS)
def energy_of_a_cell(bench, case):
    points, fault, count = case
    host = bench.ready(**PATIENT)
    host.play(*points)
    wait_for_log(host, lambda board: board.states()[-1][1] in ("fault", "job done"), "the end")
    assert host.board.faults() == [fault] * bool(fault)
    assert len(host.board.pulse_numbers()) == count


@scenario("B6", {"warm": (0, ["CELLS"], 4), "cold": (30_000, [], 6)})
def more_cells_than_the_board_has_accounts_for(bench, case):
    dark_us, faults, count = case
    host = bench.host(bench.board(cells=4, **INSTANT, **PATIENT))
    assert host.hello().cells == 4
    host.arm()
    host.play(*[here(100, x=1000 + 2000 * k, dark_us=dark_us) for k in range(6)])
    wait_for_log(host, lambda board: board.states()[-1][1] in ("fault", "job done"), "the end")
    assert host.board.faults() == faults
    assert len(host.board.pulse_numbers()) == count


# --- B7 -------------------------------------------------------------------------------------------------------------


@scenario("B7")
def gate_waits_for_settling_and_dark_us(bench):
    host = bench.ready(**BRIGHT)
    walk = [
        (here(100), 0),
        (here(100, x=CENTRE + 1), 201),
        (here(100, x=CENTRE + 10_001, y=CENTRE + 3000), 700),
        (here(100, x=CENTRE + 10_001, y=CENTRE - 7000, dark_us=699), 700),
        (here(100, x=CENTRE + 10_001, y=CENTRE + 3000, dark_us=701), 701),
        (here(100, x=CENTRE + 10_001, y=CENTRE + 3000, dark_us=4000), 4000),
        (here(100, x=CENTRE + 10_022, y=CENTRE + 3000), 202),
    ]
    host.play(*[point for point, _ in walk])
    wait_for_log(host, lambda board: len(board.pulse_numbers()) == len(walk), "all pulses")
    before_us = next(entry["t_us"] for entry in host.board.of("state") if entry["reason"] == "start")
    for pulse, (_, dark_us) in zip(host.board.of("pulse"), walk, strict=True):
        assert 0 <= pulse["on_us"] - before_us - dark_us <= host.board.late_us, pulse
        before_us = pulse["off_us"]


@scenario("B7", {"under way": 0.05, "arrived": 2.5})
def interrupted_move_still_has_to_settle(bench, pause_s):
    host = bench.ready(settle_ns_per_code=65_000, **{**BRIGHT, "settle_us": 1000})
    move_us = 1000 + 32_000 * 65
    host.play(here(100, x=CENTRE + 32_000))
    host.pause(0.05)
    assert host.send_checked("FLUSH") == []
    host.pause(pause_s - 0.05)
    host.play(here(100, x=CENTRE + 32_000), here(100, x=CENTRE + 32_000, dark_us=10))
    wait_for_log(host, lambda board: len(board.pulse_numbers()) == 2, "the pulses")
    started = [entry["t_us"] for entry in host.board.changes("start")]
    assert len(started) == 2
    first, _ = host.board.of("pulse")
    assert 0 <= first["on_us"] - max(started[1], started[0] + move_us) <= host.board.late_us


@scenario("B7")
def requested_settling_applies(bench):
    host = bench.host(bench.board(**BRIGHT))
    own = host.hello()
    limits = {name: getattr(own, name) for name in own.__dict__ if name in LIMIT_NAMES}
    assert host.send_checked("LIMITS", **{**limits, "settle_us": 3000, "settle_ns_per_code": 100}) == []
    host.arm()
    host.play(here(100), here(100, x=CENTRE + 10))
    wait_for_log(host, lambda board: len(board.pulse_numbers()) == 2, "the pulses")
    first, second = host.board.of("pulse")
    assert 0 <= second["on_us"] - first["off_us"] - 3001 <= host.board.late_us


LIMIT_NAMES = HOST["LIMITS"][2]

# --- B8 -------------------------------------------------------------------------------------------------------------

FIELD = dict(x_min=1000, x_max=64_000, y_min=2000, y_max=63_000)
OUTSIDE = {
    "left": here(1000, x=999),
    "right": here(0, x=64_001),
    "below": here(1000, y=1999),
    "above": here(0, y=63_001, duty=0),
}


@scenario("B8", OUTSIDE)
def point_outside_the_field_is_a_fault_when_queued(bench, point):
    host = bench.ready(**FIELD, **PATIENT)
    host.play(here(1000), here(1000), point)
    assert host.board.faults() == ["RANGE"]
    assert host.board.of("gate") == []
    assert host.status().queued == 0


@scenario("B8")
def corners_of_the_field_are_permitted(bench):
    host = bench.ready(**FIELD, **PATIENT)
    host.play(here(1000, x=1000, y=2000), here(1000, x=64_000, y=63_000))
    wait_for_log(host, lambda board: board.states()[-1] == ("ARMED", "job done"), "the job")
    assert [(entry["x"], entry["y"]) for entry in host.board.of("pulse")] == [(1000, 2000), (64_000, 63_000)]
