"""Simulated boards that violate one guard each: python mutants.py NAME --pty LINK ..., as the board process."""

import sys
from random import Random
from types import SimpleNamespace

from optodrive.core.errors import RemoteProtocolError
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import BoardLink
from optodrive.link.protocol.framing import CRC, HEADER, Frame, FrameDecoder, cobs_decode
from optodrive.link.protocol.states import EventReason
from optodrive.link.simulator import board_core as core_module
from optodrive.link.simulator import board_machine as machine_module
from optodrive.link.simulator import board_process
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.board_machine import BoardMachine
from optodrive.link.simulator.guards import DEFAULT_LIMITS, EmissionGuards, tighten

# Each function returns a patch: (owner, attribute, replacement).


def b1_gate_stays_on_after_running():
    return BoardMachine, "_close_gate", lambda self, reason: setattr(self, "_current_point", None)


def b1_start_tick_is_ignored():
    start = BoardMachine.start_job
    return BoardMachine, "start_job", lambda self, message: start(self, m.Start(message.job, message.first_index, 0, 1))


def b2_gate_stays_on_until_more_points():
    finish = BoardMachine._finish_point

    def burn_on(self, point):
        if self.queue:
            finish(self, point)
        else:
            self._due_us += 1000

    return BoardMachine, "_finish_point", burn_on


def b3_no_lease():
    return BoardMachine, "_lease_due_us", lambda self: None


def b3_any_session_renews():
    take = BoardCore._handle_frame
    return BoardCore, "_handle_frame", lambda self, frame: take(self, frame._replace(session=self._link.session))


def b3_anything_renews():
    obey = BoardCore._handle_unsequenced

    def renew(self, message):
        self.machine.lease_until_us = self.machine.now_us + 1000 * self.machine.limits.lease_ms
        obey(self, message)

    return BoardCore, "_handle_unsequenced", renew


def b3_host_sets_the_duration():
    obey = BoardCore._handle_unsequenced

    def believe(self, message):
        if isinstance(message, m.Lease):
            self.machine.lease_until_us = max(self.machine.lease_until_us, self.machine.now_us + 1000 * message.ms)
        else:
            obey(self, message)

    return BoardCore, "_handle_unsequenced", believe


def b3_a_short_lease_shortens():
    obey = BoardCore._handle_unsequenced

    def shorten(self, message):
        if isinstance(message, m.Lease):
            self.machine.lease_until_us = self.machine.now_us + 1000 * min(message.ms, self.machine.limits.lease_ms)
        else:
            obey(self, message)

    return BoardCore, "_handle_unsequenced", shorten


def b4_points_are_not_checked():
    static = BoardMachine._check_point
    return BoardMachine, "_check_point", lambda self, point: static(self, point._replace(on_us=0))


def b4_no_account_of_cells():
    return EmissionGuards, "on_time_us", lambda self, limits, cell, at_us: 0


def b4_by_position_and_not_by_cell():
    return EmissionGuards, "find_cells", lambda self, x, y: [(0, x, y)]


def b4_a_single_grid():
    cells = EmissionGuards.find_cells
    return EmissionGuards, "find_cells", lambda self, x, y: cells(self, x, y)[:1]


def b4_pulse_elsewhere_is_rest():
    fire = EmissionGuards.record_pulse

    def forget(self, limits, x, y, start_us, on_us, duty):
        mine = self.find_cells(x, y)
        self._on_time = {cell: account for cell, account in self._on_time.items() if cell in mine}
        fire(self, limits, x, y, start_us, on_us, duty)

    return EmissionGuards, "record_pulse", forget


def b4_interrupted_pulse_counts_as_it_was():
    close = BoardMachine._close_gate

    def refund(self, reason):
        point, was_on = self._current_point, self.gate
        close(self, reason)
        for cell in self._guards.find_cells(point.x, point.y) if was_on else ():
            on_us, _ = self._guards._on_time[cell]
            self._guards._on_time[cell] = on_us - point.on_us + self.now_us - self._gate_on_us, self.now_us

    return BoardMachine, "_close_gate", refund


def b5_any_duty():
    static = BoardMachine._check_point
    return BoardMachine, "_check_point", lambda self, point: static(self, point._replace(duty=0))


def b5_no_mean():
    return EmissionGuards, "max_window_duty_us", lambda self, start_us, on_us, duty: 0


def b6_no_bucket():
    return EmissionGuards, "bucket_uj", lambda self, limits, cell, at_us: 0


def b6_bucket_never_leaks():
    return EmissionGuards, "bucket_uj", lambda self, limits, cell, at_us: self._bucket.get(cell, (0, 0))[0]


def b6_one_bucket_for_all():
    return EmissionGuards, "find_cells", lambda self, x, y: [(0, 0, 0)]


def b6_a_single_grid():
    cells = EmissionGuards.find_cells
    return EmissionGuards, "find_cells", lambda self, x, y: cells(self, x, y)[:1]


def _begin(due):
    def begin(self, point):
        move = max(abs(point.x - self._position[0]), abs(point.y - self._position[1]))
        settle_us = self.limits.settle_us + -(-move * self.limits.settle_ns_per_code // 1000) if move else 0
        self._position, self._current_point = (point.x, point.y), point
        self._due_us = self.now_us + due(point.dark_us, settle_us)

    return BoardMachine, "_begin_point", begin


def b7_only_dark_us():
    return _begin(lambda dark_us, settle_us: dark_us)


def b7_only_settling():
    return _begin(lambda dark_us, settle_us: settle_us)


def b7_interrupted_move_is_ignored():
    return _begin(max)


def b8_no_field():
    return BoardMachine, "_check_point", lambda self, point: ""


def b8_gate_on_points_only():
    static = BoardMachine._check_point
    return BoardMachine, "_check_point", lambda self, point: static(self, point) if point.on_us else ""


def b9_inputs_are_only_reported():
    return BoardMachine, "set_input", lambda self, name, value: self.inputs.update({name: value})


def b9_not_latched():
    set_input = BoardMachine.set_input

    def forgive(self, name, value):
        set_input(self, name, value)
        if self.inputs == machine_module.SAFE_INPUTS and self.state == "FAULT":
            self.clear_fault()

    return BoardMachine, "set_input", forgive


def b9_cleared_without_a_check():
    def clear(self):
        self.fault = ""
        self._change_state(EventReason.FAULT_CLEARED)
        return ""

    return BoardMachine, "clear_fault", clear


def b9_arms_with_an_unsafe_input():
    arm = BoardMachine.request_arming

    def ignore(self, host_nonce):
        inputs, self.inputs = self.inputs, machine_module.SAFE_INPUTS
        refusal = arm(self, host_nonce)
        self.inputs = inputs
        return refusal

    return BoardMachine, "request_arming", ignore


def b10_applies_any_limits():
    return machine_module, "tighten", lambda own, requested: requested


def b10_compares_only_with_the_defaults():
    tightened = machine_module.tighten
    return machine_module, "tighten", lambda own, requested: tightened(DEFAULT_LIMITS, requested)


def b10_compares_only_with_the_own_limits():
    def tighten_limits(self, requested):
        self.limits = tighten(self._settings.limits, requested)
        return ""

    return BoardMachine, "tighten_limits", tighten_limits


def b10_limits_end_with_a_fault():
    clear = BoardMachine.clear_fault

    def restore(self):
        refusal = clear(self)
        self.limits = self.limits if refusal else self._settings.limits
        return refusal

    return BoardMachine, "clear_fault", restore


def b11_any_confirmation():
    def confirm(self, host_nonce, board_nonce):
        self._confirmed, self._key_turned = True, False
        return ""

    return BoardMachine, "confirm_arming", confirm


def b11_predictable():
    class Counting:
        def __init__(self, seed):
            self._last = 0

        def randrange(self, low, high):
            self._last += 1
            return self._last

        def getrandbits(self, bits):
            return 4

    return core_module, "random", SimpleNamespace(Random=Counting)


def b11_two_sessions_alternate():
    class Alternating(Random):
        def randrange(self, low, high):
            self._last = 15 - getattr(self, "_last", 8)
            return self._last

    return core_module, "random", SimpleNamespace(Random=Alternating)


def b11_key_edge_is_not_consumed():
    confirm = BoardMachine.confirm_arming

    def keep(self, host_nonce, board_nonce):
        refusal = confirm(self, host_nonce, board_nonce)
        self._key_turned = True
        return refusal

    return BoardMachine, "confirm_arming", keep


def b11_without_the_indicator_time():
    return machine_module, "INDICATOR_US", 1000


def b12_duplicates_are_accepted():
    def accept(self, seq):
        self._expected_seq = seq
        return True, None

    return BoardLink, "accept", accept


def b12_index_is_not_checked():
    queue_points = BoardMachine.queue_points
    return BoardMachine, "queue_points", lambda self, first, points: queue_points(self, self.queue.next_index, points)


def b13_no_crc():
    """Only the board's decoder: a host without CRC would end its sessions by itself."""

    class UncheckedDecoder(FrameDecoder):
        def _decode_frame(self, encoded):
            raw = cobs_decode(encoded)
            if raw is None or len(raw) < HEADER.size + CRC.size:
                self.counters.format_errors += 1
                return None
            return Frame(*HEADER.unpack(raw[: HEADER.size]), raw[HEADER.size : -CRC.size])

    build = BoardLink.__init__

    def build_unchecked(self):
        build(self)
        self.decoder = UncheckedDecoder()

    return BoardLink, "__init__", build_unchecked


def b13_lengths_are_not_checked():
    parse = m.parse_message

    def lenient(kind, body):
        try:
            return parse(kind, body)
        except RemoteProtocolError:
            if kind == m.Abort.TYPE:
                return m.Abort()
            raise

    return m, "parse_message", lenient


def b17_mirrors_are_only_reported():
    measure = BoardMachine._measure_mirrors
    return BoardMachine, "_measure_mirrors", lambda self: measure(self) or True


def b17_a_pulse_begins_beside_its_position():
    begin = BoardMachine._begin_pulse

    def trust(self, point):
        codes, self._feedback_codes = self._feedback_codes, 0
        begin(self, point)
        self._feedback_codes = codes

    return BoardMachine, "_begin_pulse", trust


def b17_only_a_pulse_looks_at_the_mirrors():
    def only_measure(self):
        self._watched_us = self.now_us
        self._measure_mirrors()

    return BoardMachine, "_watch_mirrors", only_measure


MUTANTS = {
    name: mutant
    for name, mutant in list(globals().items())
    if name.startswith("b") and name.partition("_")[0][1:].isdigit() and callable(mutant)
}
"""Mutants by name; the part before the first underscore is the violated guard."""

if __name__ == "__main__":
    setattr(*MUTANTS[sys.argv[1]]())
    sys.exit(board_process.main(sys.argv[2:]))
