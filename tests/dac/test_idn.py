"""IDN: bytes, the emulated device in virtual time, and what ends playback."""

import struct

import numpy as np
import pytest

from dac.bench import build_config, build_frame, build_network_display, build_train, build_verified
from dac.emulated_idn import HostDeadError, VirtualRadio
from dac.judge import judge, read_light
from dac.sample_log import dark_from_s
from optodrive.core.clock import ManualClock
from optodrive.core.errors import InputError, LinkError, LocalProtocolError
from optodrive.link.dac.devices import idn as idn_module
from optodrive.link.dac.devices.idn import Idn
from optodrive.link.dac.encoding import PointScale
from optodrive.link.dac.formats import idn as wire
from optodrive.link.dac.formats.base import Chunk, DacFormat
from optodrive.link.dac.formats.idn import IdnFormat
from optodrive.link.dac.player import play

BOUND_S = IdnFormat.host_loss_max_s
LONG = build_train(width_s=0.04, gap_s=0.004, duration_s=1.0)
WIDE = build_train(width_s=0.05, gap_s=0.001, duration_s=1.0, power_w=0.2)


class Desk:
    """Driver on an emulated device in virtual time."""

    def __init__(self, rate=40_000, name="display-16", **device):
        self.display = build_network_display("idn", name, rate)
        self.clock = ManualClock()
        self.radio = VirtualRadio(self.clock, **device)
        self.core = self.radio.core
        self.dac = Idn(self.display.config.board, self.clock, self.radio.connect)

    def play(self, sequence, on_progress=lambda share: None):
        self.plan, self.verified = build_verified(self.display, sequence)
        with self.dac:
            report = play(self.dac, self.verified, self.clock, on_progress)
        self.radio.pass_time(2.0)
        return report

    def table(self):
        return self.core.log.table(self.core.now_s)

    def light(self):
        return read_light(self.table(), self.display, PointScale.from_config(self.display.config).point_s)

    def judge(self):
        return judge(self.light(), self.plan, self.display)


@pytest.mark.parametrize("device", [{}, {"regulated": False}, {"regulated": False, "speed": 1.3}], ids=str)
@pytest.mark.parametrize("rate", [20_000, 33_333, 40_000, 50_000])
def test_the_emission_is_the_plan_and_never_more(rate, device):
    desk = Desk(rate, **device)
    played = desk.play(build_frame(desk.display))
    assert (played.underruns, played.chunks) == (0, len(desk.verified.chunks))
    emitted_j, overhang_m = desk.judge()
    assert overhang_m <= 1e-9
    assert len(desk.light().start_s) == len(desk.verified.pulses)
    speeds = desk.core.speeds
    assert min(speeds) * desk.verified.energy_j <= emitted_j * 1.3 * (1 + 1e-9)
    assert emitted_j * 1.3 <= max(speeds) * desk.verified.energy_j * (1 + 1e-9)


def test_a_level_that_ignores_the_devices_speed_is_more_than_planned(monkeypatch):
    """Mutant: the device plays a third slower, and the levels do not know it."""
    monkeypatch.setattr(IdnFormat, "stretch", 1.0)
    desk = Desk(regulated=False, speed=1.3)
    desk.play(LONG)
    with pytest.raises(AssertionError, match="above the plan"):
        desk.judge()


def test_the_device_never_plays_faster_than_it_is_asked():
    desk = Desk()
    desk.play(build_train(width_s=0.05, gap_s=0.001, duration_s=3.0, power_w=0.1))
    assert min(desk.core.speeds) > 0.999


def test_a_host_that_sends_too_far_ahead_makes_it_play_faster(monkeypatch):
    """Mutant: a lead of 120 ms, which fills the device's buffer beyond its target."""
    monkeypatch.setattr(wire, "LEAD_S", 0.12)
    desk = Desk()
    desk.play(build_train(width_s=0.05, gap_s=0.001, duration_s=3.0, power_w=0.1))
    assert min(desk.core.speeds) < 0.97


@pytest.mark.parametrize("device", [{}, {"regulated": False}], ids=str)
@pytest.mark.parametrize("after_s", np.linspace(0.05, 0.9, 8))
def test_it_is_dark_within_the_bound_after_the_host_was_killed(after_s, device):
    desk = Desk(**device)
    desk.radio.dies_at_s = after_s
    with pytest.raises(HostDeadError):
        desk.play(WIDE)
    desk.radio.pass_time(5.0)
    assert 0.0 < dark_from_s(desk.table()) <= after_s + BOUND_S


def test_a_lit_end_is_held_until_the_device_notices(monkeypatch):
    """Mutant: chunks that end within a pulse. The device holds the last sample until its time-out of a second."""
    monkeypatch.setattr(DacFormat, "check", lambda self, data: Chunk(data, 210, 210 * self.point_ticks * 1e-6))
    worst_s = 0.0
    for after_s in np.linspace(0.3, 0.4, 12):
        desk = Desk()
        pack = IdnFormat.pack
        monkeypatch.setattr(
            IdnFormat, "pack", lambda self, points, at, pack=pack: pack(self, _light_the_end(points), at)
        )
        _, verified = build_verified(desk.display, build_frame(desk.display), proven=False)
        monkeypatch.setattr(IdnFormat, "pack", pack)
        desk.radio.dies_at_s = after_s - 0.28
        with pytest.raises(HostDeadError), desk.dac:
            play(desk.dac, verified, desk.clock)
        desk.radio.pass_time(5.0)
        worst_s = max(worst_s, dark_from_s(desk.table()) - desk.radio.dies_at_s)
    assert worst_s > 0.8


def _light_the_end(points):
    points = points.copy()
    points[-1, 2] = points[:, 2].max()
    return points


def test_a_lost_chunk_ends_playback_and_is_not_sent_again():
    desk = Desk()
    desk.radio.disturb = lambda number, data: [] if number == 60 else [(0.0, data)]
    with pytest.raises(LinkError, match="did not acknowledge a chunk; nothing more is emitted"):
        desk.play(LONG)
    chunks = [sent[4:] for sent in desk.radio.sent if sent[0] == 0x41]
    assert len(chunks) == len(set(chunks))
    lost_s = desk.clock.now_s()
    desk.radio.pass_time(5.0)
    assert 0.0 < dark_from_s(desk.table()) <= lost_s
    assert desk.judge()[1] <= 1e-9


def test_a_lost_acknowledgement_ends_playback():
    desk = Desk()
    desk.radio.disturb_answer = lambda number, data: [] if number == 60 else [data]
    with pytest.raises(LinkError, match="did not acknowledge"):
        desk.play(LONG)
    desk.judge()


def test_duplicates_are_played_once():
    desk = Desk()
    desk.radio.disturb = lambda number, data: [(0.0, data), *([(0.001 * (number % 7), data)] if number > 4 else [])]
    assert desk.play(LONG).underruns == 0
    assert desk.core.dropped > 50
    desk.judge()


@pytest.mark.parametrize("delay_s", [0.05, 0.3])
def test_what_is_under_way_when_the_host_stops_emits_nothing(delay_s):
    """A chunk that overtakes no stop finds a closed channel."""
    desk, stopped = Desk(), []

    def leave(share):
        if share > 0.4:
            stopped.append(desk.clock.now_s())
            raise RuntimeError

    desk.radio.disturb = lambda number, data: [(0.0, data), *([(delay_s, data)] if len(data) > 1000 else [])]
    with pytest.raises(RuntimeError):
        desk.play(LONG, leave)
    desk.radio.pass_time(3.0)
    assert dark_from_s(desk.table()) <= stopped[0] + BOUND_S
    desk.judge()


def test_a_configuration_with_every_chunk_is_played_after_the_stop(monkeypatch):
    """Mutant: a late duplicate opens the channel again by itself."""
    send = Idn._send_message
    monkeypatch.setattr(Idn, "_send_message", lambda dac, message: send(dac, _with_configuration(message)))
    desk = Desk()

    def leave(share):
        if share > 0.4:
            raise RuntimeError

    desk.radio.disturb = lambda number, data: [(0.0, data), *([(0.3, data)] if len(data) > 1000 else [])]
    with pytest.raises(RuntimeError):
        desk.play(LONG, leave)
    desk.radio.pass_time(3.0)
    with pytest.raises(AssertionError, match="light"):
        desk.judge()


def _with_configuration(message):
    size, content, stamp = struct.unpack_from(">HHI", message)
    if content != 0x8001:
        return message
    return struct.pack(">HHI", size + len(wire.CONFIGURATION), 0xC001, stamp) + wire.CONFIGURATION + message[8:]


def test_late_duplicates_are_played_again_by_openidn():
    """Limit of that server, which no host can prevent: docs/how-to/use-a-laser-dac.md asks for a cable of its own."""
    desk = Desk(remembers_latest=False)
    desk.radio.disturb = lambda number, data: [(0.0, data), *([(0.02, data)] if number > 4 else [])]
    desk.play(LONG)
    with pytest.raises(AssertionError, match="light"):
        desk.judge()
    assert dark_from_s(desk.table()) <= desk.clock.now_s() - 2.0 + BOUND_S


def test_reordered_datagrams_emit_nothing_twice_and_nothing_late():
    desk = Desk()
    desk.radio.disturb = lambda number, data: [(0.02 if number % 9 == 0 else 0.0, data)]
    assert desk.play(LONG).chunks == len(desk.verified.chunks)
    desk.judge()


@pytest.mark.parametrize("stall_s", [0.05, 0.2, 3.0])
def test_a_stall_is_late_light_or_one_line(stall_s):
    desk = Desk()

    def stall(number, data):
        now_s = desk.clock.now_s()
        return [(max(0.0, 0.3 + stall_s - now_s) if now_s > 0.3 else 0.0, data)]

    desk.radio.disturb = stall
    if stall_s < idn_module.ANSWER_TIMEOUT_S:
        desk.play(LONG)
    else:
        with pytest.raises(LinkError, match=r"did not acknowledge|may not have received"):
            desk.play(LONG)
    desk.radio.pass_time(5.0)
    desk.judge()
    # A datagram that was under way is played when it arrives; what follows a plan's end is dark.
    assert dark_from_s(desk.table()) <= max(desk.clock.now_s() - 5.0, 0.3 + stall_s) + BOUND_S


def test_another_client_keeps_it():
    desk = Desk()
    desk.core.receive(struct.pack(">BBH", 0x40, 0, 1) + desk_message(desk), 0.0, "another")
    with pytest.raises(LinkError, match="another client plays on it"):
        desk.play(LONG)


def desk_message(desk):
    _, verified = build_verified(desk.display, LONG)
    return verified.chunks[0].data


def test_a_second_client_does_not_disturb():
    desk, said = Desk(), []

    def interfere(share):
        for command in (0x40, 0x41, 0x44, 0x45, 0x10):
            said.extend(desk.core.receive(struct.pack(">BBH", command, 0, 9), desk.clock.now_s(), "another"))

    assert desk.play(LONG, interfere).underruns == 0
    assert b"\x47" in {answer[:1] for answer in said}
    desk.judge()


@pytest.mark.parametrize(("status", "words"), [(0x80, "out of order"), (0x40, "emergency stop")])
def test_a_device_out_of_order_is_one_line(status, words):
    desk = Desk()
    desk.core.status |= status
    with pytest.raises(LinkError, match=words):
        desk.dac.open()


def test_another_unit_than_the_configured_one_is_rejected():
    desk = Desk()
    desk.dac.board = build_config(transport="idn", port="dac", uid="IDN 01").board
    with pytest.raises(InputError, match=r"board\.uid: got 'IDN 01', expected the .* is 'IDN 01020304050607\'"):
        desk.dac.open()
    assert not desk.radio.is_open


@pytest.mark.parametrize("answer", [b"", b"\x11", b"\x11\0\0\1" + b"\0" * 5, b"HTTP/1.1 400 Bad Request"])
def test_a_host_that_is_none_is_one_line(answer):
    desk = Desk()
    desk.core.receive = lambda data, now_s, source="host": [answer]
    with pytest.raises(LinkError, match="no IDN device answers at dac"):
        desk.dac.open()


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, RuntimeError])
def test_an_exception_ends_emission_within_the_bound(error):
    desk, raised = Desk(), []

    def leave(share):
        if desk.clock.now_s() > 0.4:
            raised.append(desk.clock.now_s())
            raise error

    with pytest.raises(error):
        desk.play(LONG, leave)
    desk.radio.pass_time(5.0)
    assert dark_from_s(desk.table()) <= raised[0] + BOUND_S
    assert not desk.radio.is_open


def test_without_an_interlock_nothing_is_emitted():
    desk = Desk()
    desk.dac.board = build_config(transport="idn", port="dac", interlock_watched=False).board
    with pytest.raises(InputError, match="interlock_watched"):
        desk.play(LONG)
    assert not any(sent[0] == 0x41 for sent in desk.radio.sent)


def good():
    return bytearray(IdnFormat(40_000).pack(np.full((210, 3), 0), 0))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:-1], "no whole samples"),
        (lambda data: data[:20], "no whole samples"),
        (lambda data: data[:-6], "size 1272"),
        (lambda data: data[:2] + b"\xc0" + data[3:], "content"),
        (lambda data: data[:-1] + b"\x01", "last point is not blank"),
        (lambda data: data[:8] + b"\x01" + data[9:], "duration"),
        (lambda data: data[:8] + struct.pack(">I", 210 * 200) + data[12:], "the maximum is"),
        (lambda data: data[:8] + struct.pack(">I", 5251) + data[12:], "duration"),
    ],
)
def test_unsafe_messages_are_rejected(change, words):
    IdnFormat(40_000).check(bytes(good()))
    with pytest.raises(LocalProtocolError, match=words):
        IdnFormat(40_000).check(bytes(change(good())))


def test_every_chunk_is_one_slice_and_one_datagram():
    display = build_network_display("idn")
    _, verified = build_verified(display, LONG)
    assert {chunk.points for chunk in verified.chunks} == {210}
    assert max(len(chunk.data) for chunk in verified.chunks) + 4 <= 1472
