"""For any host, the C core and the simulated board give equal answers, logs and gate edges."""

from hypothesis import event, given, settings
from hypothesis import strategies as st
from lockstep import Lockstep, arm

from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import Frame, encode_frame
from optodrive.link.simulator.guards import DEFAULT_LIMITS, BoardSettings

CENTRE = 32768
PATIENT = {"lease_ms": 60_000}
LONGEST_NOTICE_US = 100
"""The C core notices an edge at its next tick, the simulated board at once: only then both report it."""
BOARDS = st.sampled_from(
    [
        BoardSettings(
            m.Limits(**{**vars(DEFAULT_LIMITS), **limits}), cell_codes=cell_codes, queue_points=queue, key_edge=edge
        )
        for limits, cell_codes, queue, edge in (
            (PATIENT, 1300, 4096, False),
            ({**PATIENT, "mean_duty": 3000, "settle_us": 0, "settle_ns_per_code": 0}, 1300, 4096, False),
            ({**PATIENT, "spot_uj": 20_000, "rest_us": 0}, 7, 30, False),
            ({**PATIENT, "spot_leak_uw": 0, "max_on_us": 65_535}, 65_535, 24, False),
            ({**PATIENT, "settle_ns_per_code": 65_535, "x_max": 50_000}, 1, 4096, True),
            ({}, 1300, 100, False),
        )
    ]
)
CODES = st.sampled_from([0, 32_000, 32_700, 32_767, CENTRE, 33_000, 50_000, 65_535])
POINT = st.tuples(
    CODES,
    CODES,
    st.sampled_from([0, 1, 100, 499, 500, 60_000]),
    st.sampled_from([0, 1, 200, 1000, 5000, 50_000, 65_535]),
    st.sampled_from([0, 3000, 30_000, 65_535]),
)
TAME = st.tuples(
    st.sampled_from([32_000, 32_700, 32_767, CENTRE, 33_000, 40_000]),
    st.sampled_from([32_767, CENTRE, 34_000]),
    st.sampled_from([0, 300, 500, 3000]),
    st.sampled_from([0, 1, 200, 1000, 5000, 9000]),
    st.sampled_from([0, 3000, 30_000, 65_535]),
)
POINTS = st.one_of(
    st.lists(TAME, min_size=1, max_size=24),
    st.lists(TAME, min_size=1, max_size=6),
    st.tuples(st.lists(TAME, max_size=4), POINT).map(lambda pair: [*pair[0], pair[1]]),
)
LIMITS = st.dictionaries(
    st.sampled_from([name for name in vars(DEFAULT_LIMITS) if name != "lease_ms"]),
    st.sampled_from([100, 5000, 20_000, 40_000, 65_535]),
    max_size=2,
).map(lambda changed: m.Limits(**{**vars(DEFAULT_LIMITS), **PATIENT, **changed}))
KINDS = st.sampled_from(m.HOST_MESSAGES + m.BOARD_MESSAGES)
DAMAGE = st.tuples(st.sampled_from(["flip", "cut", "double", "split", "junk", "long"]), st.floats(0, 1))
WAIT = st.tuples(st.just("wait"), st.sampled_from([1, 10, 100, 1000, 7777, 60_000]))
PLAY = st.tuples(st.just("play"), POINTS)
USUAL = st.one_of(
    PLAY,
    PLAY,
    WAIT,
    WAIT,
    st.tuples(st.just("queue"), POINTS),
    st.tuples(st.sampled_from(["start", "start later", "end", "lease", "get", "executed", "clock"]), st.none()),
    st.tuples(st.sampled_from(["start on trigger", "trigger", "triggers"]), st.none()),
)
UNUSUAL = st.one_of(
    st.tuples(st.sampled_from(["arm", "hello", "short lease", "clear", "flush", "disarm", "abort"]), st.none()),
    st.tuples(st.sampled_from(["link lost", "reset", "again", "ahead"]), st.none()),
    st.tuples(st.just("wait"), st.sampled_from([500_000, 2_000_000, 12_000_000])),
    st.tuples(st.just("limits"), LIMITS),
    st.tuples(st.just("input"), st.sampled_from(m.INPUTS)),
    st.tuples(st.just("anything"), st.tuples(KINDS, st.binary(max_size=60), st.integers(0, 3))),
    st.tuples(st.just("damage"), DAMAGE),
)
STEPS = st.integers(0, 5).flatmap(lambda n: UNUSUAL if n == 5 else USUAL)
EPISODES = st.lists(
    st.tuples(st.one_of(st.none(), st.none(), LIMITS), st.lists(STEPS, min_size=3, max_size=20)), min_size=1, max_size=4
)
"""Each episode begins with HELLO, optional LIMITS, and arming."""


def messages(core, what, detail):
    """Return the host's messages of a step, mostly valid in the board's state."""
    first = core.machine.queue.first_index
    if what in ("play", "queue"):
        data = m.Data(core.machine.queue.next_index, b"".join(m.POINT.pack(*point) for point in detail))
        end = core.machine.queue.next_index + len(detail)
        return [data, m.Start(1, first, 0, 3), m.End(1, end)] if what == "play" else [data]
    return {
        "start": [m.Start(1, first, 0, 2)],
        "start later": [m.Start(1, first, core.machine.current_tick + 50_000, 1)],
        "start on trigger": [m.StartOnTrigger(1, first, 5000, 300)],
        "triggers": [m.GetTriggers()],
        "end": [m.End(1, core.machine.queue.next_index)],
        "clear": [m.ClearFault()],
        "lease": [m.Lease(60_000)],
        "short lease": [m.Lease(30)],
        "hello": [m.Hello(1, 0, 3)],
        "flush": [m.Flush()],
        "disarm": [m.Disarm()],
        "abort": [m.Abort()],
        "get": [m.Get()],
        "clock": [m.ClockRequest(77)],
        "executed": [m.GetExecuted(max(0, core.machine.queue.done_index - 40))],
        "limits": [detail],
    }[what]


def damaged(data, how, where):
    at = int(where * (len(data) - 1))
    return {
        "flip": lambda: [data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]],
        "cut": lambda: [data[:at]],
        "double": lambda: [data + data],
        "split": lambda: [data[:at], data[at:]],
        "junk": lambda: [bytes(range(255, 255 - at % 200, -1)), b"\0"],
        "long": lambda: [b"\7" * (200 + at), b"\7" * 100 + b"\0"],
    }[how]()


def step(both, what, detail):
    core = both.python
    if what == "wait":
        both.wait(detail)
    elif what == "arm":
        arm(both)
    elif what == "input":
        both.set_input(detail, not core.machine.inputs[detail])
    elif what == "link lost":
        both.both(lambda board: board.on_link_lost(both.now_us))
    elif what == "trigger":
        both.both(lambda board: board.receive_trigger(both.now_us))
        both.wait(LONGEST_NOTICE_US)
    elif what == "reset":
        both.both(lambda board: board.reset(both.now_us))
    elif what == "anything":
        kind, body, ahead = detail
        seq = (core._link.expected_seq + ahead) % 256
        both.raw(encode_frame(Frame(kind.TYPE, seq, core._link.session, body.ljust(kind.LAYOUT.size, b"\1"))))
    elif what in ("again", "ahead"):
        both.raw(both.frame(m.Disarm(), ahead=-1 if what == "again" else 2))
    elif what == "damage":
        for portion in damaged(both.frame(m.Get()) + both.frame(m.ClockRequest(9)), *detail):
            both.raw(portion)
    else:
        both.raw(b"".join(both.frame(x, ahead) for ahead, x in enumerate(messages(core, what, detail))))


@settings(max_examples=2 * settings.default.max_examples)
@given(BOARDS, EPISODES, st.integers(0, 2**32))
def test_both_boards_behave_identically(library, board, episodes, seed):
    both = Lockstep(library, board, seed=seed)
    for limits, steps in episodes:
        arm(both, limits)
        for what, detail in steps:
            step(both, what, detail)
    both.wait(1_000_000)
    both.send(m.Get(), m.GetExecuted(0))
    pulses = sum(entry["event"] == "pulse" for entry in both.log)
    event(f"{min(pulses, 5)} pulses, 5 meaning more")
    for entry in both.log:
        if entry["event"] == "fault":
            event(f"fault {entry['fault']}")


def test_more_records_than_are_kept(library):
    both = Lockstep(library)
    arm(both)
    point = m.POINT.pack(CENTRE, CENTRE, 2, 0, 0)
    for k in range(400):
        both.send(m.Data(24 * k, point * 24))
        if k == 0:
            both.send(m.Start(1, 0, 0, 1))
        both.wait(40)
    both.wait(10_000)
    for first in (0, 1000, 24 * 400 - 4096 - 1, 24 * 400 - 4096, 24 * 400 - 4096 + 1, 24 * 400 - 3, 24 * 400):
        both.send(m.GetExecuted(first))
    assert both.received[-1].first_index == 24 * 400 - 3


def test_a_report_over_more_than_32_bits_of_time_is_two(library):
    both = Lockstep(library, BoardSettings(m.Limits(**{**vars(DEFAULT_LIMITS), **PATIENT})))
    arm(both)
    point = m.POINT.pack(CENTRE, CENTRE, 0, 100, 999)
    both.send(m.Data(0, point), m.Start(1, 0, 0, 1), m.End(1, 1))
    both.wait(1000)
    later_us = both.now_us + (1 << 32)
    both.send(m.Data(1, point), m.Start(2, 1, later_us, 1), m.End(2, 2), m.Lease(60_000))
    while both.now_us < later_us + 1000:
        both.wait(59_000_000)
        both.send(m.Lease(60_000))
    both.send(m.GetExecuted(0), m.GetExecuted(1))
    assert [(x.first_index, len(x.records)) for x in both.received[-2:]] == [(0, 1), (1, 1)]
