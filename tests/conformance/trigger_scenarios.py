"""Scenarios of the trigger input: jobs that await an edge, and the edges that a board counts."""

from bench import BRIGHT, CENTRE, act, here
from scenario import scenario

DIM = dict(duty=999)
TRIGGER = act("trigger")
DELAY_US = 200_000
"""Long enough for a second edge in real time before the job begins."""
EDGE_US = 1
"""Error of an edge's time."""


def await_trigger(host, *points, delay_us=DELAY_US, wait_ms=60_000):
    """Queue points and let their job, with its END, start at the next edge. Return the reasons of the NAKs."""
    first, frames = host.index, [host.data(*points)] if points else []
    fields = dict(job=1, first_index=first, delay_us=delay_us, wait_ms=wait_ms)
    frames += [host.frame("START_ON_TRIGGER", **fields), host.frame("END", job=1, end_index=host.index)]
    return host.order(*frames)


def read_triggers(host):
    """Return the board's answer to GET_TRIGGERS."""
    answers, _ = host.request(host.frame("GET_TRIGGERS"))
    (triggers,) = [message for message in answers if message.name == "TRIGGERS"]
    return triggers


def pull(host):
    """Let an edge come, and wait until the board has logged it. Return the log entry."""
    count = len(host.board.of("trigger"))
    host.board.next_step()
    host.wait(lambda: len(host.board.of("trigger")) > count, "an edge")
    return host.board.of("trigger")[-1]


def assert_begins_at(host, start_us, index=0, dark_us=0):
    """Check when the mirrors' first point, which does not move them, was lit."""
    host.wait(lambda: index in host.board.pulse_numbers(), "the pulse")
    (pulse,) = [entry for entry in host.board.of("pulse") if entry["index"] == index]
    assert -EDGE_US <= pulse["on_us"] - start_us - dark_us <= host.board.late_us + EDGE_US


@scenario("trigger", {"a long delay": DELAY_US, "the least delay for all boards": 1000})
def job_begins_its_delay_after_the_edge(bench, delay_us):
    host = bench.ready(TRIGGER, **BRIGHT)
    assert await_trigger(host, here(300, dark_us=700, **DIM), here(300, **DIM), delay_us=delay_us) == []
    host.pause(0.05)
    assert host.status().state == "RUNNING"
    assert host.board.of("gate") == []
    assert_begins_at(host, pull(host)["t_us"] + delay_us, dark_us=700)
    host.wait_for_change("job done")
    assert host.board.pulse_numbers() == [0, 1]


@scenario("trigger")
def each_job_awaits_an_edge_of_its_own(bench):
    host = bench.ready(TRIGGER, TRIGGER, TRIGGER, **BRIGHT)
    pull(host)
    for index in range(2):
        assert await_trigger(host, here(300, **DIM)) == []
        host.pause(0.05)
        assert host.board.pulse_numbers() == list(range(index)), "an earlier edge"
        assert_begins_at(host, pull(host)["t_us"] + DELAY_US, index)
        host.wait_for_change("job done", count=index + 1)


@scenario("trigger")
def only_the_first_edge_counts_for_a_job(bench):
    host = bench.ready(TRIGGER, TRIGGER, **BRIGHT)
    assert await_trigger(host, here(300, **DIM)) == []
    edge = pull(host)
    host.pause(0.01)
    pull(host)
    assert_begins_at(host, edge["t_us"] + DELAY_US)


@scenario("trigger")
def job_with_a_start_tick_ignores_edges(bench):
    host = bench.ready(TRIGGER, **BRIGHT)
    tick = host.status().tick + 2_000_000
    assert host.play(here(300, **DIM), start_tick=tick) == []
    pull(host)
    host.wait(lambda: host.of("EXECUTED"), "the report")
    ((on_tick, *_),) = host.of("EXECUTED")[0].records
    assert 0 <= on_tick - tick <= host.board.late_us


@scenario("trigger", {"with a wait": 300, "without one": 0})
def job_without_an_edge_ends_disarmed_and_dark(bench, wait_ms):
    host = bench.ready(TRIGGER, **BRIGHT)
    await_trigger(host, here(300, **DIM), wait_ms=wait_ms)
    over = host.wait_for_change("hold too long")
    assert over["state"] == "DISARMED"
    host.status()
    (began,) = [message for message in host.of("EVENT") if message.reason == "start"]
    (ended,) = [message for message in host.of("EVENT") if message.reason == "hold too long"]
    assert 0 <= ended.tick - began.tick - 1000 * wait_ms <= host.board.late_us
    pull(host)
    host.pause(0.3)
    assert host.board.of("gate") == []


@scenario(
    "trigger",
    {
        "FLUSH": ("flush", "ARMED", lambda host: host.send("FLUSH")),
        "ABORT": ("abort", "DISARMED", lambda host: host.send("ABORT")),
        "DISARM": ("disarm", "DISARMED", lambda host: host.send("DISARM")),
    },
)
def waiting_job_can_be_stopped(bench, case):
    reason, state, stop = case
    host = bench.ready(TRIGGER, **BRIGHT)
    assert await_trigger(host, here(300, **DIM), delay_us=1000) == []
    stop(host)
    assert host.wait_for_change(reason)["state"] == state
    pull(host)
    host.pause(0.1)
    assert host.board.of("gate") == []
    assert host.status().queued == 0


@scenario("trigger")
def job_can_be_stopped_within_its_delay(bench):
    host = bench.ready(TRIGGER, **BRIGHT)
    assert await_trigger(host, here(300, **DIM), delay_us=10_000_000) == []
    pull(host)
    host.send("FLUSH")
    host.wait_for_change("flush")
    assert host.board.of("gate") == []


@scenario("trigger")
def waiting_job_needs_its_lease(bench):
    host = bench.ready(TRIGGER, **{**BRIGHT, "lease_ms": 2000})
    assert await_trigger(host, here(300, **DIM), delay_us=1000) == []
    host.wait_for_change("fault", lease=False)
    assert host.board.faults() == ["LINK"]
    pull(host)
    host.pause(0.1)
    assert host.board.of("gate") == []


@scenario("trigger")
def start_on_trigger_is_refused_in_this_order(bench):
    host = bench.greeted(**BRIGHT)
    fields = dict(job=1, first_index=5, delay_us=1000, wait_ms=1000)
    assert host.send_checked("START_ON_TRIGGER", **fields) == ["STATE"]
    host.arm()
    assert host.send_checked("START_ON_TRIGGER", **fields) == ["INDEX"]
    assert host.send_checked("START_ON_TRIGGER", **(fields | {"first_index": 0})) == ["INDEX"], "no point"
    host.order(host.data(here(300, **DIM)))
    assert host.send_checked("START_ON_TRIGGER", **(fields | {"first_index": 0})) == []
    assert host.send_checked("START_ON_TRIGGER", **(fields | {"first_index": 0})) == ["STATE"]


@scenario("trigger")
def edges_are_counted_with_the_tick_of_the_last(bench):
    host = bench.greeted(TRIGGER, TRIGGER, **BRIGHT)
    none = read_triggers(host)
    assert (none.count, none.tick) == (0, 0)
    edges, ticks = [], []
    for count in (1, 2):
        before = host.status().tick
        edges.append(pull(host)["t_us"])
        host.pause(0.01)
        reported = read_triggers(host)
        assert reported.count == count
        assert before - EDGE_US <= reported.tick <= host.status().tick
        ticks.append(reported.tick)
    assert abs(ticks[1] - ticks[0] - (edges[1] - edges[0])) <= 2 * EDGE_US  # ticks count from power-up


@scenario("trigger")
def first_point_of_a_triggered_job_moves_the_mirrors_at_its_start(bench):
    host = bench.ready(TRIGGER, **(BRIGHT | {"settle_us": 5000, "settle_ns_per_code": 0}))
    assert await_trigger(host, here(300, x=CENTRE + 1000, **DIM), delay_us=1000) == []
    assert_begins_at(host, pull(host)["t_us"] + 1000, dark_us=5000)
