"""Session with the simulated board, over an in-memory link and a manual clock."""

import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

from displays import DISPLAYS
from optodrive.core.clock import ManualClock
from optodrive.core.errors import InputError, LinkError, NotReadyError
from optodrive.core.types.plans import EMPTY_PLAN, LimitedPlan
from optodrive.device.config import Config
from optodrive.link.board_setup import build_board_requirements
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.framing import FrameDecoder, encode_frame
from optodrive.link.protocol.quantisation import quantise
from optodrive.link.session.board_link import BOOT_MAX_S, CONNECT_TIMEOUT_S, SILENCE_TIMEOUT_S
from optodrive.link.session.board_view import FAULT_HINTS, get_fault_hint
from optodrive.link.session.clock_sync import DRIFT_MAX, ClockSync
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.simulator.guards import DEFAULT_LIMITS, BoardSettings
from optodrive.link.simulator.virtual_run import MemoryLink

CONFIG = DISPLAYS["display-16"].config
STEP_S = 0.002


def drop_nothing(frame):
    return False


class Wire(MemoryLink):
    """In-memory link that can drop frames, after which each exchange takes as long as over a serial port."""

    def __init__(self, core, clock):
        super().__init__(core, clock)
        self.cut = False
        self.drop_frame = drop_nothing
        self.sent = []
        self._up, self._down = FrameDecoder(), FrameDecoder()

    def write(self, data):
        frames = list(self._up.feed(data))
        self.sent += frames
        if not self.cut:
            super().write(b"".join(encode_frame(frame) for frame in frames if not self.drop_frame(frame)))

    def read(self, timeout_s):
        if self.drop_frame is not drop_nothing:
            self._clock.sleep(STEP_S)
        data = super().read(timeout_s)
        if self.cut:
            return b""
        return b"".join(encode_frame(frame) for frame in self._down.feed(data) if not self.drop_frame(frame))


class Rig:
    def __init__(self, settings=None, config=CONFIG, start_s=5.0):
        self.log = []
        self.clock = ManualClock(start_s)
        self.core = BoardCore(settings, self.log.append, seed=2)
        self.link = Wire(self.core, self.clock)
        self.session = BoardSession(self.link, self.clock, build_board_requirements(config))

    def connect(self):
        self.session.connect()
        return self

    def run(self, duration_s, lease=True):
        until_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < until_s:
            self.session.step(STEP_S, lease)

    def until(self, condition, patience_s=20.0, lease=True):
        give_up_s = self.clock.now_s() + patience_s
        while not condition():
            assert self.clock.now_s() < give_up_s, f"timed out: {self.session.board}"
            self.session.step(STEP_S, lease)

    def arm(self):
        self.session.arm()
        self.until(lambda: self.session.is_ready)
        return self

    def play(self, plan):
        return self.session.begin(quantise(plan, self.session.scale), self.session.board_s() + 0.05)

    def pulses(self):
        return [entry for entry in self.log if entry["event"] == "pulse"]

    def states(self):
        return [entry["state"] for entry in self.log if entry["event"] == "state"]


def plan(n=100, width_s=0.002, period_s=0.004, power_w=0.5):
    """Return a limited plan: n pulses that alternate between four positions."""
    pixel = np.arange(n) % 4
    ones = np.ones(n)
    columns = {
        "start_s": 0.003 + period_s * np.arange(n),
        "width_s": width_s * ones,
        "x_rad": 0.006 * (pixel - 1.5),
        "y_rad": 0.002 * (pixel - 1.5),
        "power_w": power_w * (1 + pixel) / 4,
        "pixel": pixel,
        "stage": np.zeros(n, dtype=np.int64),
    }
    rest = {"energy_j": ones, "trimmed_j": 0 * ones, "reason": np.full(n, ""), "headroom_k": ones}
    return LimitedPlan(**{**vars(EMPTY_PLAN), **columns, **rest})


@pytest.fixture
def rig():
    return Rig().connect()


# --- connecting -----------------------------------------------------------------------------------------------------


def test_the_handshake_tightens_limits_sets_the_clock_and_ends_disarmed(rig):
    session = rig.session
    assert session.connected
    assert session.is_acknowledged
    assert session.board.state == "DISARMED"
    assert session.board.uid == BoardSettings().uid
    assert rig.core.machine.limits.spot_uj == session._requirements.limits.spot_uj < DEFAULT_LIMITS.spot_uj
    assert session.board_s() == pytest.approx(rig.clock.now_s(), abs=0.003)
    assert session.collect_link_stats()["round_trip_ms"] > 0


def test_hello_is_repeated_until_the_board_answers():
    rig = Rig()
    rig.link.drop_frame = lambda frame: frame.type == m.Hello.TYPE and rig.clock.now_s() < 6.3
    rig.connect()
    hellos = [frame for frame in rig.link.sent if frame.type == m.Hello.TYPE]
    assert 5 <= len(hellos) <= 8
    assert len({frame.body for frame in hellos}) == len(hellos), "each has its own nonce"


@pytest.mark.parametrize(
    ("kinds", "says", "timeout_s"),
    [
        (range(256), "is open, but no board answers", BOOT_MAX_S),
        ((0x90, 0x98, 0x83), "answers HELLO but nothing else", CONNECT_TIMEOUT_S),
    ],
)
def test_a_missing_answer_is_a_link_error_within_the_timeout(kinds, says, timeout_s):
    rig = Rig()
    rig.link.drop_frame = lambda frame: frame.type in kinds
    with pytest.raises(LinkError, match=says):
        rig.connect()
    assert rig.clock.now_s() < 5.0 + timeout_s + 0.1
    assert not rig.session.connected


def changed(section, **values):
    table = CONFIG.model_dump()
    table[section] |= values
    return Config.model_validate(table)


@pytest.mark.parametrize(
    ("settings", "config", "says"),
    [
        (
            BoardSettings(uid="00" * 12),
            changed("board", uid="11" * 12),
            "board.uid: got '1111.*', expected the board of .* has '0000",
        ),
        (BoardSettings(replace(DEFAULT_LIMITS, settle_us=310)), CONFIG, "scanner.bandwidth_hz: got 1700.0"),
        (BoardSettings(replace(DEFAULT_LIMITS, settle_ns_per_code=500)), CONFIG, "scanner.slew_rad_per_s: got 100.0"),
        (
            BoardSettings(replace(DEFAULT_LIMITS, max_on_us=49_999)),
            CONFIG,
            "limits.pulse_width_max_s: got 0.05, expected at most 0.049999, the .* .max_on_us",
        ),
        (BoardSettings(replace(DEFAULT_LIMITS, full_power_uw=2_000_000)), CONFIG, "laser.max_power_w: got 2.45"),
        (BoardSettings(replace(DEFAULT_LIMITS, spot_uj=100_000)), CONFIG, "limits.pulse_energy_max_j: got 0.125"),
        (
            BoardSettings(replace(DEFAULT_LIMITS, spot_leak_uw=1_000_000)),
            CONFIG,
            "limits.pixel_mean_power_max_w: got 1.3",
        ),
        (
            BoardSettings(replace(DEFAULT_LIMITS, x_min=31_000)),
            CONFIG,
            "display x: got 3.* to .*, expected codes within 31000 to 65535, the limit of",
        ),
        (
            BoardSettings(replace(DEFAULT_LIMITS, y_max=33_000)),
            CONFIG,
            "display y: got .*, expected codes within 0 to 33000, the limit of the board's firmware",
        ),
        (
            BoardSettings(),
            changed("display", pitch_m=2.5e-3),
            "display.pitch_m: got 0.0025, expected a board whose cell_codes are at most 1066, the distance of",
        ),
        (BoardSettings(cells=15), CONFIG, "display pixels: got 16, expected at most 15, the spots that this board can"),
    ],
)
def test_an_incompatible_board_is_rejected_with_the_key(settings, config, says):
    rig = Rig(settings, config)
    with pytest.raises(InputError, match=says) as caught:
        rig.connect()
    assert "\n" not in str(caught.value)
    assert not rig.session.connected


@pytest.mark.parametrize(("configured_w", "firmware_uw"), [(5.0, 2_450_000), (1.0, 2_450_000), (2.45, 5_000_000)])
def test_a_contradiction_about_full_power_names_both_sides_and_advises_neither_number(configured_w, firmware_uw):
    """A stronger diode with the firmware's default: obeying "expected 2.45" would count half of its light."""
    rig = Rig(
        BoardSettings(replace(DEFAULT_LIMITS, full_power_uw=firmware_uw)), changed("laser", max_power_w=configured_w)
    )
    with pytest.raises(InputError) as caught:
        rig.connect()
    line = str(caught.value)
    assert line.startswith(f"laser.max_power_w: got {configured_w}, expected the firmware's full power, now ")
    assert f"{firmware_uw * 1e-6:g} W (by `optodrive board build`)" in line
    assert "measure it there with a power meter" in line
    assert line.endswith("set both to what is measured, and neither lower")


def test_the_full_power_of_a_curve_is_what_the_board_must_count_with():
    curve = ((0.0, 0.0), (0.5, 1.5), (1.0, 2.45))
    config = changed("laser", curve=curve)
    with pytest.raises(
        InputError, match=r"laser\.max_power_w: got 3\.0, expected the firmware's full power, now 2\.45 W"
    ):
        Rig(BoardSettings(replace(DEFAULT_LIMITS, full_power_uw=2_450_000)), config).connect()
    limits = build_board_requirements(config).limits
    assert limits.full_power_uw == 3_000_000
    # At full duty it counts 3.0 for 2.45 W.
    plain = build_board_requirements(CONFIG).limits
    assert limits.spot_uj == pytest.approx(plain.spot_uj * 3.0 / 2.45, abs=1)
    assert limits.spot_leak_uw == pytest.approx(plain.spot_leak_uw * 3.0 / 2.45, abs=1)


FITS = m.HelloReply(
    major=1,
    minor=9,
    host_nonce=0,
    session=1,
    firmware=0,
    uid=bytes(12),
    capabilities=0,
    tick_hz=1_000_000,
    queue_points=99,
    rx_window=8,
    cell_codes=1,
    cells=16,
    window_pulses=1,
    reset_cause=0,
    limits=DEFAULT_LIMITS,
)


@pytest.mark.parametrize(("field", "value"), [("major", 2), ("tick_hz", 999)])
def test_another_protocol_or_tick_is_rejected(field, value):
    requirements = build_board_requirements(CONFIG)
    requirements.check_board(FITS)
    with pytest.raises(InputError, match=f"{value}"):
        requirements.check_board(replace(FITS, **{field: value}))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("modulation", "on_off", r"laser\.modulation: got 'on_off', expected 'pwm': this board's firmware does not"),
        ("whole_periods", False, r"laser\.whole_periods: got False, expected True: this board's firmware does not"),
    ],
)
def test_widths_in_microseconds_are_refused_for_a_board_that_does_not_promise_them(key, value, message):
    config = changed("laser", **{key: value})
    with pytest.raises(InputError, match=message):
        build_board_requirements(config).check_board(FITS)
    Rig(config=config).connect()


def test_a_board_that_does_not_measure_the_mirrors_is_refused_where_it_must():
    requirements = build_board_requirements(changed("scanner", feedback=True))
    requirements.check_board(replace(FITS, capabilities=m.CAPABILITY_FEEDBACK))
    with pytest.raises(InputError, match=r"scanner\.feedback: got 'true', expected false, as this board does not"):
        requirements.check_board(FITS)


@pytest.mark.parametrize("name", sorted(DISPLAYS))
def test_the_simulated_board_meets_the_requirements_of_every_display(name):
    Rig(config=DISPLAYS[name].config).connect().arm()


def test_limits_are_tightened_on_a_board_in_fault(rig):
    rig.core.set_input("estop", True, round(rig.clock.now_s() * 1e6))
    rig.session.close()
    rig.core.set_input("estop", False, round(rig.clock.now_s() * 1e6))
    rig.connect()
    assert rig.session.board.state == "FAULT"
    rig.session.disarm()
    rig.until(lambda: rig.session.board.state == "DISARMED")
    rig.arm()
    assert rig.core.machine.limits.spot_uj < DEFAULT_LIMITS.spot_uj


# --- arming and playing ---------------------------------------------------------------------------------------------


def test_arm_takes_the_board_s_two_seconds(rig):
    began_s = rig.clock.now_s()
    rig.arm()
    assert 2.0 < rig.clock.now_s() - began_s < 2.1
    with pytest.raises(NotReadyError, match="the board is ARMED"):
        rig.session.arm()


# --- lease, silence, faults -----------------------------------------------------------------------------------------


def test_silence_is_a_link_error_with_the_error_counts(rig):
    rig.link.cut = True
    began_s = rig.clock.now_s()
    with pytest.raises(LinkError, match=r"sent nothing for 2 s; 0 bad frames at the host"):
        rig.run(10.0)
    assert SILENCE_TIMEOUT_S < rig.clock.now_s() - began_s < SILENCE_TIMEOUT_S + 0.1


def test_a_restarted_board_is_detected_and_reconnects_disarmed(rig):
    rig.arm()
    rig.core.reset(round(rig.clock.now_s() * 1e6))
    with pytest.raises(LinkError):
        rig.run(10.0)
    rig.session.disconnect()
    rig.connect()
    assert rig.session.board.state == "DISARMED"
    assert rig.session.board_s() == pytest.approx(rig.core.machine.current_tick * 1e-6, abs=0.01)


@pytest.mark.parametrize("kind", [m.HelloReply.TYPE, m.ClockReply.TYPE])
def test_a_failed_connect_keeps_the_clock(rig, kind):
    """Thermal states are in board time, so a lost clock would shift them by the board's uptime."""
    rig.run(3.0)
    rig.session.disconnect()
    rig.link.drop_frame = lambda frame: frame.type == kind
    with pytest.raises(LinkError):
        rig.connect()
    assert rig.session.board_s() == pytest.approx(rig.core.machine.current_tick * 1e-6, abs=0.01)
    rig.link.drop_frame = drop_nothing
    before_s = rig.session.board_s()
    rig.connect()
    assert rig.session.board_s() - before_s < CONNECT_TIMEOUT_S


def test_a_fault_is_reported_with_the_pulse_that_it_truncated(rig):
    rig.arm()
    planned = plan(100)
    job = rig.play(planned)
    rig.until(lambda: rig.core.gate and len(rig.pulses()) > 20)
    rig.core.set_input("interlock", False, round(rig.clock.now_s() * 1e6))
    rig.until(lambda: rig.session.board.state == "FAULT")
    rig.run(0.1)
    done = job.build_executed(planned, build_board_requirements(CONFIG).scale)
    assert len(done) == len(rig.pulses())
    assert not done.complete
    assert done.width_s[-1] < planned.width_s[0]
    assert rig.session.board.fault == "INTERLOCK"
    with pytest.raises(NotReadyError, match=r"in FAULT INTERLOCK: .*close the enclosure.*disarm, and arm again"):
        rig.session.arm()
    rig.session.disarm()
    rig.run(0.05)
    assert rig.session.pop_refusal() == "INPUT"
    assert rig.session.pop_refusal() is None
    assert get_fault_hint("INTERLOCK") == rig.session.board.to_dict()["hint"]


def test_no_points_are_sent_after_a_fault():
    rig = Rig(BoardSettings(queue_points=60)).connect().arm()
    rig.play(plan(400))
    rig.until(lambda: len(rig.pulses()) > 20)
    rig.core.set_input("estop", True, round(rig.clock.now_s() * 1e6))
    rig.until(lambda: rig.session.board.state == "FAULT")
    rig.link.sent.clear()
    rig.run(0.5)
    assert m.Data.TYPE not in {frame.type for frame in rig.link.sent}


def test_every_fault_except_those_of_the_electronics_has_a_hint():
    assert set(m.FAULTS) - set(FAULT_HINTS) == {"", "TICK", "READBACK"}
    assert "no likely cause" in get_fault_hint("TICK")


# --- aborting ---------------------------------------------------------------------------------------------------


def test_an_abort_is_confirmed_before_the_next_session_and_limits_precede_arming(rig):
    rig.arm()
    rig.play(plan(500))
    rig.run(0.3)
    hellos, rig.link.sent = [], []

    def drop_frame(frame):
        hellos.extend([frame] if frame.type == m.Hello.TYPE else [])
        return frame.type == m.Hello.TYPE and len(hellos) == 1

    rig.link.drop_frame = drop_frame
    rig.session.abort()
    assert not rig.session.abort_confirmed
    rig.until(lambda: rig.session.abort_confirmed)
    assert rig.core.state == rig.session.board.state == "DISARMED"
    assert not rig.session.is_acknowledged
    rig.arm()
    assert len(hellos) == 2
    sent = [frame.type for frame in rig.link.sent if frame.type in (m.Limits.TYPE, m.ArmReq.TYPE)]
    assert sent == [m.Limits.TYPE, m.ArmReq.TYPE]
    assert rig.core.machine.limits.spot_uj < DEFAULT_LIMITS.spot_uj


def test_a_board_that_ended_hold_can_be_armed_again(rig):
    rig.arm()
    rig.link.drop_frame = lambda frame: frame.type in (m.Data.TYPE, m.End.TYPE) and frame.seq >= 8
    rig.play(plan(500))
    rig.until(lambda: rig.session.board.state == "DISARMED")
    assert rig.session.last_event_reason == "hold too long"
    rig.link.drop_frame = drop_nothing
    rig.run(0.2)
    rig.arm()
    planned = plan(50)
    job = rig.play(planned)
    rig.until(lambda: job.is_finished)
    assert job.build_executed(planned, build_board_requirements(CONFIG).scale).complete


def test_a_rejected_start_is_reported(rig):
    rig.arm()
    job = rig.play(plan(5))
    job.first_index += 1  # START names a point other than the first queued one
    rig.run(0.1)
    assert rig.session.pop_refusal() == "INDEX"
    assert rig.core.state == "ARMED"
    assert rig.pulses() == []
    rig.session.flush()
    rig.until(lambda: rig.session.is_ready)


def test_close_sends_abort_and_a_reconnect_does_not_arm(rig):
    rig.arm()
    rig.play(plan(500))
    rig.run(0.2)
    rig.session.close()
    assert rig.link.sent[-1].type == m.Abort.TYPE
    assert rig.core.state == "DISARMED"
    assert not rig.core.gate
    rig.connect()
    rig.run(1.0)
    assert rig.session.board.state == "DISARMED"
    assert rig.states()[-1] == "DISARMED"


# --- clock ----------------------------------------------------------------------------------------------------------


def add_exchange(sync, request_s, reply_s, board_s):
    sync.finish_exchange(sync.start_exchange(request_s), reply_s, board_s)


def test_the_clock_uses_the_narrowest_bracket():
    sync = ClockSync()
    assert sync.board_s(5.0) == 0.0
    assert not sync.is_synchronised
    assert sync.round_trip_s is None
    add_exchange(sync, 10.000, 10.010, 110.009)  # wide, 4 ms off
    add_exchange(sync, 10.020, 10.021, 110.0205)  # narrow, correct
    add_exchange(sync, 10.030, 10.050, 110.031)
    assert sync.board_s(10.1) == pytest.approx(110.1, abs=1e-9)
    assert sync.round_trip_s == pytest.approx(0.001)
    sync.finish_exchange(0, 10.2, 0.0)  # no request had this stamp
    assert sync.board_s(10.1) == pytest.approx(110.1, abs=1e-9)


def test_an_old_narrow_bracket_is_discarded():
    sync = ClockSync()
    add_exchange(sync, 0.0, 0.001, 100.0005)
    late_s = 0.002 / DRIFT_MAX
    add_exchange(sync, late_s, late_s + 0.002, 100.0 + late_s + 0.001 + 0.001)
    assert sync.board_s(late_s) == pytest.approx(100.0 + late_s + 0.001)


def test_other_threads_may_read_the_state_at_any_time():
    """The reads of a REST request succeed while the loop connects and disconnects."""
    rig, errors, finished = Rig(), [], threading.Event()

    def read():
        try:
            while not finished.is_set():
                rig.session.collect_link_stats()
                rig.session.board_s()
                rig.session.board.to_dict()
        except Exception as error:
            errors.append(error)

    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    reader = threading.Thread(target=read)
    reader.start()
    try:
        for _ in range(300):
            rig.connect()
            rig.session.disconnect()
    finally:
        finished.set()
        reader.join()
        sys.setswitchinterval(interval_s)
    assert not errors
