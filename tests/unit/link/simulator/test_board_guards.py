"""B1 to B13 of PROTOCOL.md on the simulated board, and detection of boards that violate them."""

import tomllib
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
from board_bench import CENTRE, Bench, here, naks

from optodrive.core.errors import RemoteProtocolError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import BoardLink
from optodrive.link.protocol.framing import CRC, HEADER, Frame, FrameDecoder, cobs_decode, encode_frame
from optodrive.link.protocol.states import EventReason
from optodrive.link.simulator import board_core as core_module
from optodrive.link.simulator import board_machine as machine_module
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.board_machine import BoardMachine
from optodrive.link.simulator.guards import EmissionGuards

REFUSED = tomllib.loads((Path(__file__).parents[4] / "firmware_protocol" / "refused.toml").read_text())["case"]
OTHER_CELL = CENTRE + 2000


# --- B1: gate off at reset, at boot, in every state but RUNNING, and while settling ---------------------------------


def check_b1(make):
    ends = {
        "flush": lambda b: b.send(m.Flush()),
        "disarm": lambda b: b.send(m.Disarm()),
        "abort": lambda b: b.send(m.Abort()),
        "hello": lambda b: b.hello(),
        "input": lambda b: b.core.set_input("interlock", False, b.now_us),
        "link lost": lambda b: b.core.on_link_lost(b.now_us),
        "reset": lambda b: b.core.reset(b.now_us),
    }
    for name, end in ends.items():
        b = make().ready()
        assert b.edges == [], "gate moved before RUNNING"
        b.play(here(40_000))
        b.wait(10_000)
        assert b.core.gate
        end(b)
        assert not b.core.gate, f"lit after {name}"
        assert b.edges[-1] == (b.now_us, False)
    b = make().ready()
    began_us = b.now_us
    b.play(here(1000, x=CENTRE + 10_000))
    b.wait(5000)
    assert b.edges[0][0] >= began_us + 200 + 500, "lit while settling"


def b1_gate_stays_on_after_running(patch):
    patch.setattr(BoardMachine, "_close_gate", lambda self, reason: setattr(self, "_current_point", None))


# --- B2: queue empty: gate off within 100 µs ------------------------------------------------------------------------


def check_b2(make):
    b = make().ready()
    began_us = b.now_us
    b.play(here(10_000), end=False)
    b.wait(40_000)
    assert b.edges[0] == (began_us, True)
    assert [edge for edge in b.edges if began_us < edge[0] <= began_us + 10_100] == [(began_us + 10_000, False)]
    assert b.state == "HOLD"


def b2_gate_stays_on_until_more_points(patch):
    finish = BoardMachine._finish_point

    def burn_on(self, point):
        if self.queue:
            finish(self, point)
        else:
            self._due_us += 1000

    patch.setattr(BoardMachine, "_finish_point", burn_on)


# --- B3: no valid LEASE in this session for lease_ms: FAULT LINK ----------------------------------------------------


def check_b3(make):
    for state in ("ARMING", "ARMED", "RUNNING", "HOLD"):
        b = make()
        b.hello()
        if state == "ARMING":
            b.challenge()
        else:
            b.arm()
        if state in ("RUNNING", "HOLD"):
            b.play(*[here(20_000, x=CENTRE + 2000 * k) for k in range(10 if state == "RUNNING" else 1)], end=False)
            b.wait(21_000)
        assert b.state == state
        b.send(m.Lease(100))
        last_us = b.now_us
        useless = [
            b.frame(m.Lease(100), session=b.session ^ 1),
            b.frame(m.Lease(100), session=0),
            b.frame(m.Lease(100))[:-3] + b"\0",
            encode_frame(Frame(m.Lease.TYPE | 0x80, 0, b.session, m.Lease(100).encode_body())),
            b.frame(m.Get()),
            b.frame(m.ClockRequest(1)),
        ]
        for _ in range(11):
            b.wait(10_000, lease=False)
            b.raw(b"".join(useless))
        assert (b.state, b.fault) == ("FAULT", "LINK"), state
        assert b.of("fault")[-1]["t_us"] == last_us + 100_000
        assert not b.core.gate
        b.send(m.Lease(100))
        assert b.state == "FAULT"
    b = make().ready()
    b.send(m.Lease(60_000))
    b.wait(101_000, lease=False)
    assert b.fault == "LINK", "a host's lease may not be longer than the board's"


def b3_no_lease(patch):
    patch.setattr(BoardMachine, "_lease_due_us", lambda self: None)


def b3_any_session_renews(patch):
    take = BoardCore._handle_frame
    patch.setattr(
        BoardCore, "_handle_frame", lambda self, frame: take(self, frame._replace(session=self._link.session))
    )


def b3_anything_renews(patch):
    obey = BoardCore._handle_unsequenced

    def renew(self, message):
        self.machine.lease_until_us = self.machine.now_us + 100_000
        obey(self, message)

    patch.setattr(BoardCore, "_handle_unsequenced", renew)


def b3_host_sets_the_duration(patch):
    def obey(self, message):
        if isinstance(message, m.Lease):
            self.machine.lease_until_us = self.machine.now_us + 1000 * message.ms

    patch.setattr(BoardCore, "_handle_unsequenced", obey)


# --- B4: gate on at most max_on a point, and a cell, however many points it is split over ---------------------------


def check_b4(make):
    b = make().ready()
    assert naks(b.play(here(50_001))) == ["STATE"] * 3
    assert (b.fault, b.edges) == ("ON_TIME", [])

    splits = [
        [here(30_000), here(20_001)],
        [here(30_000), here(20_001, x=CENTRE + 300)],
        [here(30_000, x=CENTRE + 649), here(20_001, x=CENTRE + 650)],
        [here(30_000, x=CENTRE + 649, y=CENTRE - 651), here(20_001, x=CENTRE + 650, y=CENTRE - 650)],
        [here(30_000), here(20_001, dark_us=499)],
        [here(25_000, duty=6553), here(25_001, duty=6553)],
    ]
    for points in splits:
        b = make().ready()
        b.play(*points)
        b.wait(60_000)
        assert b.fault == "ON_TIME", points
        assert len(b.pulses) == 1
    for points in ([here(30_000), here(20_000)], [here(30_000, duty=6553), here(30_000, dark_us=500, duty=6553)]):
        b = make().ready()
        b.play(*points)
        b.wait(80_000)
        assert (b.fault, b.state, len(b.pulses)) == ("", "ARMED", 2)

    b = make({"settle_us": 100, "settle_ns_per_code": 0}).ready()
    b.play(here(30_000, duty=999), here(100, x=OTHER_CELL), here(30_000, duty=999))
    b.wait(80_000)
    assert (b.fault, len(b.pulses)) == ("ON_TIME", 2), "a glance at another cell is no rest"


def b4_points_are_not_checked(patch):
    static = BoardMachine._check_point
    patch.setattr(BoardMachine, "_check_point", lambda self, point: static(self, point._replace(on_us=0)))


def b4_no_account_of_cells(patch):
    patch.setattr(EmissionGuards, "on_time_us", lambda self, limits, cell, at_us: 0)


def b4_by_position_and_not_by_cell(patch):
    patch.setattr(EmissionGuards, "find_cells", lambda self, x, y: [(0, x, y)])


def b4_a_single_grid(patch):
    cells = EmissionGuards.find_cells
    patch.setattr(EmissionGuards, "find_cells", lambda self, x, y: cells(self, x, y)[:1])


# --- B5: duty at most max_duty; mean power over any second at most mean_duty ----------------------------------------


def sweep(count, on_us=20_000, **point):
    return [here(on_us, x=1000 + 2000 * k, **point) for k in range(count)]


def check_b5(make):
    b = make({"max_duty": 40_000}).ready()
    assert naks(b.send(b.data(here(1000, duty=40_001)))) == ["STATE"]
    assert (b.fault, b.edges) == ("DUTY", [])

    b = make({"mean_duty": 6553, "settle_us": 0, "settle_ns_per_code": 0}).ready()
    b.play(*sweep(10))
    b.wait(300_000)
    assert (b.fault, len(b.pulses)) == ("MEAN_POWER", 4), "100 ms of 1 s would be 6554, so only four of 20 ms pass"
    b = make({"mean_duty": 6554, "settle_us": 0, "settle_ns_per_code": 0}).ready()
    b.play(*sweep(5), here(100, dark_us=60_000), end=False)
    b.wait(161_000)
    assert (b.fault, len(b.pulses)) == ("MEAN_POWER", 5)

    b = make({"mean_duty": 6554, "settle_us": 0, "settle_ns_per_code": 0}).ready()
    b.play(*sweep(5), *[here(0, dark_us=60_000, duty=0)] * 15, *sweep(5))
    b.wait(1_200_000)
    assert (b.fault, len(b.pulses)) == ("", 10), "what is older than a second no longer counts"


def b5_no_duty(patch):
    static = BoardMachine._check_point
    patch.setattr(BoardMachine, "_check_point", lambda self, point: static(self, point._replace(duty=0)))


def b5_no_mean(patch):
    patch.setattr(EmissionGuards, "max_window_duty_us", lambda self, start_us, on_us, duty: 0)


# --- B6: energy of a cell, a bucket that leaks ----------------------------------------------------------------------


def check_b6(make):
    b = make().ready()  # 150 mJ, 1.4 W, 2.45 W
    b.play(here(45_000), here(45_000, dark_us=1000))  # 110.25 mJ each, and 64.4 mJ leak away between them
    b.wait(100_000)
    assert (b.fault, len(b.pulses)) == ("SPOT", 1)

    b = make().ready()
    b.play(here(45_000), here(45_000, dark_us=1000, x=OTHER_CELL), here(45_000, dark_us=1000))
    b.wait(200_000)
    assert (b.fault, len(b.pulses)) == ("", 3), "another cell has its own bucket, and this one has leaked"

    b = make().ready()
    b.play(here(45_000, x=CENTRE + 649), here(45_000, dark_us=1000, x=CENTRE + 650))
    b.wait(100_000)
    assert (b.fault, len(b.pulses)) == ("SPOT", 1), "a cell's border parts no spot"

    b = make().ready()
    b.play(*[here(10_000, dark_us=9000, duty=65535)] * 24)
    b.wait(600_000)
    assert (b.fault, len(b.pulses)) == ("", 24), "24.5 mJ every 19 ms leak away at 26.6 mJ"

    b = make().ready()
    b.play(*[here(15_000, dark_us=5000, duty=65535)] * 24)
    b.wait(600_000)
    assert (b.fault, len(b.pulses)) == ("SPOT", 13), "36.75 mJ every 20 ms leave 8.75 mJ each time"


def b6_no_bucket(patch):
    patch.setattr(EmissionGuards, "bucket_uj", lambda self, limits, cell, at_us: 0)


def b6_bucket_never_leaks(patch):
    patch.setattr(EmissionGuards, "bucket_uj", lambda self, limits, cell, at_us: self._bucket.get(cell, (0, 0))[0])


def b6_one_bucket_for_all(patch):
    patch.setattr(EmissionGuards, "find_cells", lambda self, x, y: [(0, 0, 0)])


def b6_a_single_grid(patch):
    cells = EmissionGuards.find_cells
    patch.setattr(EmissionGuards, "find_cells", lambda self, x, y: cells(self, x, y)[:1])


# --- B7: no gate until the host's settling and the board's own are over ---------------------------------------------


def first_light_after_us(b):
    began_us = b.now_us
    b.wait(20_000)
    pulsed = [t_us - began_us for t_us, on in b.edges if on and t_us >= began_us]
    assert pulsed
    return pulsed[0]


def check_b7(make):
    for x, y, dark_us, expected in (
        (CENTRE, CENTRE, 0, 0),
        (CENTRE + 1, CENTRE, 0, 201),
        (CENTRE + 10_000, CENTRE - 3000, 0, 700),
        (CENTRE, CENTRE - 10_000, 699, 700),
        (CENTRE, CENTRE - 10_000, 701, 701),
        (CENTRE, CENTRE, 4000, 4000),
    ):
        b = make().ready()
        b.play(here(100, x=x, y=y, dark_us=dark_us))
        assert first_light_after_us(b) == expected

    b = make().ready()
    b.play(here(100, x=CENTRE + 20_000))  # 1200 µs away
    b.wait(50)
    b.send(m.Flush())
    b.play(here(100, x=CENTRE + 20_000))
    assert first_light_after_us(b) == 1150, "a move that was broken off is still under way"

    b = make().ready()
    b.send(m.Disarm(), m.Limits(**{**vars(b.limits), "settle_us": 3000}))
    b.arm()
    b.play(here(100, x=CENTRE + 1))
    assert first_light_after_us(b) == 3001


def _begin(due):
    def begin(self, point):
        move = max(abs(point.x - self._position[0]), abs(point.y - self._position[1]))
        settle_us = self.limits.settle_us + -(-move * self.limits.settle_ns_per_code // 1000) if move else 0
        self._position, self._current_point = (point.x, point.y), point
        self._due_us = self.now_us + due(point.dark_us, settle_us)

    return begin


def b7_only_dark_us(patch):
    patch.setattr(BoardMachine, "_begin_point", _begin(lambda dark_us, settle_us: dark_us))


def b7_only_settling(patch):
    patch.setattr(BoardMachine, "_begin_point", _begin(lambda dark_us, settle_us: settle_us))


def b7_interrupted_move_is_ignored(patch):
    patch.setattr(BoardMachine, "_begin_point", _begin(max))


# --- B8: a position outside the field is a fault, and nothing is lit ------------------------------------------------


def check_b8(make):
    for x, y in ((999, CENTRE), (64_001, CENTRE), (CENTRE, 1999), (CENTRE, 63_001), (0, 0), (65535, 65535)):
        b = make({"x_min": 1000, "x_max": 64_000, "y_min": 2000, "y_max": 63_000}).ready()
        b.play(here(1000), here(1000, x=x, y=y))
        b.wait(20_000)
        assert (b.state, b.fault, b.edges) == ("FAULT", "RANGE", []), (x, y)
    b = make({"x_min": 1000, "x_max": 64_000, "y_min": 2000, "y_max": 63_000}).ready()
    b.play(here(1000, x=1000, y=2000), here(1000, x=64_000, y=63_000))
    b.wait(30_000)
    assert [(p["x"], p["y"]) for p in b.of("pulse")] == [(1000, 2000), (64_000, 63_000)]


def b8_no_field(patch):
    patch.setattr(BoardMachine, "_check_point", lambda self, point: "")


# --- B9: interlock, key and emergency stop: gate off within 1 ms, latched -------------------------------------------


def check_b9(make):
    for name, unsafe in (("interlock", False), ("key", False), ("estop", True)):
        b = make().ready()
        b.play(here(40_000))
        b.wait(10_000)
        assert b.core.gate
        b.core.set_input(name, unsafe, b.now_us)
        opened_us = b.now_us
        b.wait(1000)
        assert not b.core.gate
        assert b.edges[-1][0] <= opened_us + 1000
        assert (b.state, b.fault) == ("FAULT", name.upper())
        assert naks(b.send(m.ClearFault())) == ["INPUT"], "cleared while the cause is there"
        b.core.set_input(name, not unsafe, b.now_us)
        b.wait(50_000)
        assert b.state == "FAULT", "not latched"
        assert naks(b.send(m.ArmReq(1))) == ["STATE"]
        assert naks(b.send(m.ClearFault())) == []
        assert (b.state, b.fault) == ("DISARMED", "")
        b.core.set_input(name, unsafe, b.now_us)
        b.send(m.ClearFault())
        b.hello()
        assert naks(b.send(m.ArmReq(1))) == ["STATE"]


def b9_inputs_are_only_reported(patch):
    patch.setattr(BoardMachine, "set_input", lambda self, name, value: self.inputs.update({name: value}))


def b9_not_latched(patch):
    set_input = BoardMachine.set_input

    def forgive(self, name, value):
        set_input(self, name, value)
        if self.inputs == machine_module.SAFE_INPUTS and self.state == "FAULT":
            self.clear_fault()

    patch.setattr(BoardMachine, "set_input", forgive)


def b9_cleared_without_a_check(patch):
    def clear(self):
        self.fault = ""
        self._change_state(EventReason.FAULT_CLEARED)
        return ""

    patch.setattr(BoardMachine, "clear_fault", clear)


# --- B10: the host only tightens ------------------------------------------------------------------------------------

OWN = {"max_on_us": 20_000, "max_duty": 30_000, "mean_duty": 20_000, "spot_uj": 90_000, "spot_leak_uw": 1_000_000}
OWN |= {"full_power_uw": 2_000_000, "x_min": 100, "x_max": 32_000, "y_min": 200, "y_max": 32_700}
OWN |= {"settle_us": 300, "settle_ns_per_code": 60, "rest_us": 700, "lease_ms": 80}
MORE_IS_LOOSER = ("max_on_us", "max_duty", "mean_duty", "spot_uj", "spot_leak_uw", "x_max", "y_max", "lease_ms")


def check_b10(make):
    own = m.Limits(**OWN)
    looser = m.Limits(**{name: value * 2 if name in MORE_IS_LOOSER else 0 for name, value in OWN.items()})
    tighter = m.Limits(**{n: v // 2 if n in MORE_IS_LOOSER else v + 50 for n, v in OWN.items()})
    b = make(OWN)
    assert b.hello().limits == own
    for requested, power in ((looser, 9), (own, 1)):
        assert naks(b.send(m.Limits(**{**vars(requested), "full_power_uw": power}))) == []
        assert b.limits == own
    for requested in (tighter, looser, own):
        b.send(requested)
        assert vars(b.limits) == {**vars(tighter), "full_power_uw": OWN["full_power_uw"]}
    b.arm()
    assert naks(b.send(looser)) == ["STATE"]
    b.send(b.data(here(OWN["max_on_us"] // 2 + 1, x=10_000, y=10_000)))
    assert b.fault == "ON_TIME"
    assert b.hello().limits == own, "a new session begins with the board's own"
    assert b.limits == own


def b10_applies_any_limits(patch):
    patch.setattr(machine_module, "tighten", lambda own, requested: requested)


def b10_compares_only_with_the_own_limits(patch):
    tightened = machine_module.tighten
    patch.setattr(machine_module, "tighten", lambda own, requested: tightened(m.Limits(**OWN), requested))


# --- B11: arming needs a fresh nonce, and the key's edge where the board wants it -----------------------------------


def states_of(b):
    return {entry["state"] for entry in b.of("state")}


def check_b11(make):
    for wrong in (lambda c: (c.host_nonce, c.board_nonce ^ 1), lambda c: (c.host_nonce ^ 1, c.board_nonce)):
        b = make()
        b.hello()
        challenge = b.challenge()
        assert naks(b.send(m.ArmConfirm(*wrong(challenge)))) == ["NONCE"]
        assert naks(b.send(m.ArmConfirm(challenge.host_nonce, challenge.board_nonce))) == ["STATE"], "used twice"
        b.wait(2_100_000)
        assert "ARMED" not in states_of(b)

    b = make().ready()
    b.play(here(1000))
    b.wait(10_000)
    b.send(m.Disarm())
    recorded = list(b.host_bytes)
    for again in ("as it is", "after a reset"):
        b.log.clear()
        if again == "after a reset":
            b.core.reset(b.now_us)
        for portion in recorded:
            b.raw(portion)
            b.wait(20_000, lease=False)
        b.wait(2_100_000, lease=False)
        assert not {"ARMED", "RUNNING"} & states_of(b), f"armed by a recording, {again}"
        assert b.edges == []

    b = make(key_edge=True)
    b.hello()
    assert naks(b.send(m.ArmReq(1))) == ["KEY_EDGE"], "a key that was on at power-up was not turned"
    turn_key(b)
    b.arm()
    b.send(m.Disarm())
    assert naks(b.send(m.ArmReq(1))) == ["KEY_EDGE"], "one turn arms once"
    turn_key(b)
    b.arm()


def turn_key(b):
    for value in (False, True):
        b.core.set_input("key", value, b.now_us)
    b.send(m.ClearFault())


def b11_any_confirmation(patch):
    def confirm(self, host_nonce, board_nonce):
        self._confirmed = True
        self._key_turned = False
        return ""

    patch.setattr(BoardMachine, "confirm_arming", confirm)


def b11_predictable(patch):
    class Constant:
        def __init__(self, seed):
            self._last = 8

        def randrange(self, low, high):
            self._last = 15 - self._last
            return self._last

        def getrandbits(self, bits):
            return 4

    patch.setattr(core_module, "random", SimpleNamespace(Random=Constant))


def b11_key_edge_is_not_consumed(patch):
    confirm = BoardMachine.confirm_arming

    def keep(self, host_nonce, board_nonce):
        refusal = confirm(self, host_nonce, board_nonce)
        self._key_turned = True
        return refusal

    patch.setattr(BoardMachine, "confirm_arming", keep)


# --- B12: each index at most once, in order -------------------------------------------------------------------------


def check_b12(make):
    b = make().ready()
    first = b.frame(b.data(*[here(100, dark_us=900, duty=999)] * 4))
    second = b.data(*[here(100, dark_us=900, duty=999)] * 4)
    assert naks(b.raw(first)) == []
    assert naks(b.raw(first + first)) == [], "duplicates are acknowledged, no more"
    assert naks(b.raw(b.frame(second, seq=b.seq + 1))) == ["SEQUENCE"], "one is missing before it"
    b.send(m.Start(1, 0, 0, 1))
    b.wait(1000)
    assert naks(b.raw(first)) == []
    assert naks(b.send(m.Data(0, second.points))) == ["INDEX"], "old indices under a new seq"
    assert naks(b.send(m.Data(2, second.points))) == ["INDEX"]
    assert naks(b.send(m.Data(5, second.points))) == ["INDEX"], "a gap"
    assert naks(b.send(second)) == []
    assert naks(b.send(second)) == ["INDEX"]
    b.send(m.End(1, 8))
    b.wait(50_000)
    assert [index for index, _, _ in b.pulses] == list(range(8))
    assert all(off <= on for (_, _, off), (_, on, _) in pairwise(b.pulses))
    assert naks(b.send(m.Data(0, second.points))) == ["INDEX"], "nor when the job is over"
    assert naks(b.send(m.Data(0xFFFF_FFFF, second.points))) == ["INDEX"], "indices do not wrap"
    assert b.state == "ARMED"


def b12_duplicates_are_accepted(patch):
    def accept(self, seq):
        self._expected_seq = seq
        return True, None

    patch.setattr(BoardLink, "accept", accept)


def b12_index_is_not_checked(patch):
    queue_points = BoardMachine.queue_points
    patch.setattr(
        BoardMachine, "queue_points", lambda self, first, points: queue_points(self, self.queue.next_index, points)
    )


# --- B13: malformed frames change counters only ---------------------------------------------------------------------


def check_b13(make):
    b = make().ready()
    b.play(here(40_000, duty=9999), *[here(1000, dark_us=9000)] * 10, end=False)
    b.wait(5000)
    assert b.core.gate
    before, counted = b.condition(), [0, 0]
    whole = b.frame(b.data(here(1000)))
    b.index -= 1
    hostile = [bytes.fromhex(case["wire"]) for case in REFUSED]
    hostile += [whole[:cut] + b"\0" for cut in range(1, len(whole) - 1)]
    hostile += [
        bytes((*whole[:at], whole[at] ^ bit, *whole[at + 1 :])) for at in range(len(whole) - 1) for bit in (1, 128)
    ]
    hostile += [b.frame(m.Abort())[:-2] + b"\0", bytes(range(256)) + b"\0", b"\xff" * 3000 + b"\0"]
    for data in hostile:
        assert b.raw(data) == []
        assert b.condition() == before
        now_counted = b.bad_frames()
        assert sum(now_counted) > sum(counted), data
        counted = now_counted
    assert len(b.of("rx_error")) == len(hostile)
    status = b.status()
    assert (status.crc_errors, status.format_errors) == tuple(counted)


def b13_no_crc(patch):
    def frame(self, encoded):
        raw = cobs_decode(encoded)
        if raw is None or len(raw) < HEADER.size + CRC.size:
            self.counters.format_errors += 1
            return None
        return Frame(*HEADER.unpack(raw[: HEADER.size]), raw[HEADER.size : -CRC.size])

    patch.setattr(FrameDecoder, "_decode_frame", frame)


def b13_lengths_are_not_checked(patch):
    parse = m.parse_message

    def lenient(kind, body):
        try:
            return parse(kind, body)
        except RemoteProtocolError:
            if kind == m.Abort.TYPE:
                return m.Abort()
            raise

    patch.setattr(m, "parse_message", lenient)


# --- all of them ----------------------------------------------------------------------------------------------------

CHECKS = {name: check for name, check in list(globals().items()) if name.startswith("check_b")}
MUTANTS = {
    name: mutant
    for name, mutant in list(globals().items())
    if name.startswith("b") and name.partition("_")[0][1:].isdigit() and callable(mutant)
}


def test_there_are_thirteen_and_each_has_a_mutant():
    assert set(CHECKS) == {f"check_b{k}" for k in range(1, 14)}
    assert {f"check_{name.partition('_')[0]}" for name in MUTANTS} == set(CHECKS)


@pytest.mark.parametrize("name", CHECKS)
def test_holds(name):
    CHECKS[name](Bench)


@pytest.mark.parametrize("name", MUTANTS)
def test_mutant_is_detected(name, monkeypatch):
    MUTANTS[name](monkeypatch)
    with pytest.raises(AssertionError):
        CHECKS[f"check_{name.partition('_')[0]}"](Bench)
