"""Ether Dream: bytes, the emulated device in virtual time, and what ends playback."""

from contextlib import suppress

import numpy as np
import pytest

from dac.bench import build_config, build_frame, build_network_display, build_train, build_verified
from dac.emulated_ether_dream import HostDeadError, VirtualStream
from dac.judge import judge, read_light
from dac.sample_log import dark_from_s
from optodrive.core.clock import ManualClock
from optodrive.core.errors import InputError, LinkError, LocalProtocolError
from optodrive.link.dac.devices.ether_dream import EtherDream
from optodrive.link.dac.encoding import PointScale
from optodrive.link.dac.formats.base import Chunk
from optodrive.link.dac.formats.ether_dream import EtherDreamFormat
from optodrive.link.dac.player import play

BOUND_S = EtherDreamFormat.host_loss_max_s
LONG = build_train(width_s=0.04, gap_s=0.004, duration_s=1.0)


class Desk:
    """Opened driver on an emulated device in virtual time."""

    def __init__(self, rate=40_000, name="display-16", latency_s=3e-4, **device):
        self.display = build_network_display("ether_dream", name, rate)
        self.clock = ManualClock()
        self.stream = VirtualStream(self.clock, latency_s, **device)
        self.core = self.stream.core
        self.dac = EtherDream(self.display.config.board, self.clock, self.stream.connect)

    def play(self, sequence, on_progress=lambda share: None):
        self.plan, self.verified = build_verified(self.display, sequence)
        with self.dac:
            return play(self.dac, self.verified, self.clock, on_progress)

    def table(self):
        return self.core.log.table(self.core.now_s)

    def light(self):
        return read_light(self.table(), self.display, PointScale.from_config(self.display.config).point_s)


@pytest.mark.parametrize("extra_ticks", [0, 1])
@pytest.mark.parametrize("rate", [20_000, 33_333, 40_000, 50_000])
def test_the_emission_is_the_plan_and_never_more(rate, extra_ticks):
    desk = Desk(rate, extra_ticks=extra_ticks)
    played = desk.play(build_frame(desk.display))
    assert (played.underruns, played.chunks) == (0, len(desk.verified.chunks))
    light = desk.light()
    assert len(light.start_s) == len(desk.verified.pulses)
    emitted_j, overhang_m = judge(light, desk.plan, desk.display)
    assert overhang_m <= 1e-9
    assert emitted_j == pytest.approx(desk.verified.energy_j, rel=1.0 / EtherDreamFormat(rate).point_ticks)
    assert emitted_j <= desk.verified.energy_j * (1 + 1e-12)
    assert desk.core.playback == 0


def test_a_level_that_ignores_the_stretch_is_more_than_planned(monkeypatch):
    """Mutant: points are taken to last what the rate states."""
    monkeypatch.setattr(EtherDreamFormat, "stretch", 1.0)
    desk = Desk(extra_ticks=1)
    desk.play(build_train(power_w=2.45 * 819 / 4095, width_s=0.02))
    with pytest.raises(AssertionError, match="above the plan"):
        judge(desk.light(), desk.plan, desk.display)


@pytest.mark.parametrize("after_s", np.linspace(0.05, 0.9, 12))
def test_it_is_dark_within_the_bound_after_the_host_was_killed(after_s):
    desk = Desk()
    desk.stream.dies_at_s = after_s
    with pytest.raises(HostDeadError):
        desk.play(LONG)
    desk.stream.pass_time(5.0)
    assert 0.0 < dark_from_s(desk.table()) <= after_s + BOUND_S


def test_the_bound_is_tight():
    worst_s = 0.0
    for after_s in np.linspace(0.2, 0.3, 25):
        desk = Desk()
        desk.stream.dies_at_s = after_s
        with pytest.raises(HostDeadError):
            desk.play(build_train(width_s=0.05, gap_s=0.001, duration_s=0.5, power_w=0.1))
        desk.stream.pass_time(1.0)
        worst_s = max(worst_s, dark_from_s(desk.table()) - after_s)
    assert 0.7 * BOUND_S < worst_s <= BOUND_S


@pytest.mark.parametrize("stall_s", [0.005, 0.03, 0.06, 0.4, 3.0])
def test_a_stall_ends_dark_in_one_line_or_is_not_noticed(stall_s):
    desk = Desk()
    desk.stream.stalls.append((0.3, 0.3 + stall_s))
    if stall_s < 0.04:
        assert desk.play(LONG).underruns == 0
        return
    with pytest.raises(LinkError, match=r"ran out of points|link to the Ether Dream lost") as caught:
        desk.play(LONG)
    assert "\n" not in str(caught.value)
    desk.stream.pass_time(5.0)
    assert dark_from_s(desk.table()) <= 0.3 + BOUND_S


def test_after_an_underrun_nothing_of_the_plan_is_emitted():
    """The device has centred the mirrors, and what follows of a cut pulse would meet them on their way."""
    desk = Desk()
    desk.stream.stalls.append((0.3, 0.4))
    with pytest.raises(LinkError, match="nothing more is emitted"):
        desk.play(LONG)
    assert desk.core.starved == 1
    assert dark_from_s(desk.table()) < 0.4
    assert judge(desk.light(), desk.plan, desk.display)[1] <= 1e-9


def test_a_driver_that_prepares_again_lights_the_mirrors_way(monkeypatch):
    """Mutant: playback goes on after an underrun."""
    refuse = EtherDream._command

    def insist(dac, command, body=b""):
        if command == b"d" and dac._ask(b"?")[1].playback == 0:
            dac._begun = False
            refuse(dac, b"p")
        refuse(dac, command, body)

    def is_ready(dac):
        return dac._ask(b"?")[1].fullness <= 899

    monkeypatch.setattr(EtherDream, "_command", insist)
    monkeypatch.setattr(EtherDream, "is_ready", is_ready)
    worst_m = -1.0
    for stall_s in np.linspace(0.3, 0.4, 12):
        desk = Desk()
        desk.stream.stalls.append((stall_s, stall_s + 0.1))
        desk.play(LONG)
        worst_m = max(worst_m, judge(desk.light(), desk.plan, desk.display)[1])
    assert worst_m > 1e-4


@pytest.mark.parametrize("command", [b"s", b"\xff", b"\0"])
def test_a_second_client_that_stops_it_ends_playback_in_one_line(command):
    desk, done = Desk(), []

    def interfere(share):
        if share > 0.3 and not done:
            done.append(desk.clock.now_s())
            desk.core.run(command)

    with pytest.raises(LinkError, match=r"the Ether Dream stopped|refused command"):
        desk.play(LONG, interfere)
    assert dark_from_s(desk.table()) <= done[0] + 1e-3


@pytest.mark.parametrize("command", [b"c", b"p", b"?", b"b\0\0\x40\x9c\0\0", b"q\x10\x27\0\0"])
def test_a_second_client_that_commands_adds_no_light(command):
    """It clears an emergency stop, prepares, asks, begins before there are enough points, or queues another rate."""
    desk = Desk()
    with suppress(LinkError):
        desk.play(LONG, lambda share: desk.core.run(command))
    desk.stream.pass_time(2.0)
    assert judge(desk.light(), desk.plan, desk.display)[1] <= 1e-9
    assert len(desk.light().start_s) == len(desk.verified.pulses) or command[:1] == b"b"


def test_a_cable_that_is_pulled_is_dark_at_once_and_the_next_play_begins():
    desk, done = Desk(), []

    def unplug(share):
        if share > 0.3 and not done:
            done.append(desk.clock.now_s())
            desk.core.lose_link()

    with pytest.raises(LinkError, match="emergency stop"):
        desk.play(LONG, unplug)
    assert dark_from_s(desk.table()) <= done[0] + 1e-3
    desk.dac = EtherDream(desk.display.config.board, desk.clock, desk.stream.connect)
    assert desk.play(LONG).underruns == 0


def test_a_pressed_emergency_stop_is_not_cleared():
    desk = Desk()
    desk.core._estop(2)
    with pytest.raises(LinkError, match="remove its cause"):
        desk.play(LONG)
    assert desk.core.engine == 3
    assert not len(desk.light().start_s)


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, RuntimeError])
def test_an_exception_ends_emission(error):
    desk, raised = Desk(), []

    def leave(share):
        if desk.clock.now_s() > 0.4:
            raised.append(desk.clock.now_s())
            raise error

    with pytest.raises(error):
        desk.play(LONG, leave)
    assert dark_from_s(desk.table()) <= raised[0] + 0.002
    assert not desk.stream.is_open


def test_without_an_interlock_nothing_is_sent():
    desk = Desk()
    board = build_config(transport="ether_dream", port="dac", interlock_watched=False).board
    desk.dac = EtherDream(board, desk.clock, desk.stream.connect)
    with pytest.raises(InputError, match="interlock_watched"):
        desk.play(LONG)
    assert set(desk.stream.sent) <= {b"s"}


def test_a_lit_end_is_never_sent():
    """Mutant: a chunk that the encoder did not end dark; the driver refuses it, and the device keeps nothing."""
    desk = Desk()
    _, verified = build_verified(desk.display, LONG)
    data = bytearray(verified.chunks[3].data)
    data[-18 + 6 : -18 + 8] = b"\xff\xff"
    with desk.dac:
        desk.dac.start()
        with pytest.raises(LocalProtocolError, match="last point is not blank"):
            desk.dac.send(Chunk(bytes(data), 1, 0.02))
    assert not any(sent[:1] == b"d" for sent in desk.stream.sent)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "holds no point"),
        (b"d\x02\x00" + bytes(18), "for 2 points"),
        (b"p\x01\x00" + bytes(18), "command b'p'"),
        (b"d\x01\x00" + b"\x00\x80" + bytes(16), "changes the rate"),
        (b"d\x01\x00" + bytes(14) + b"\x01\x00\x00\x00", "user channel"),
        (b"d\x01\x00" + bytes(6) + b"\x01\x00" + bytes(10), "last point is not blank"),
        (b"d\xe8\x03" + bytes(18_000), "takes 899"),
        (b"d\xdc\x05" + bytes(27_000), "the maximum is"),
    ],
)
def test_unsafe_commands_are_rejected(data, words):
    with pytest.raises(LocalProtocolError, match=words):
        EtherDreamFormat(50_000 if len(data) < 20_000 else 40_000).check(data)


def test_a_host_that_answers_nothing_or_something_else_is_one_line():
    desk = Desk()
    desk.stream.connect = lambda address, timeout: (_ for _ in ()).throw(
        ConnectionRefusedError(111, "Connection refused")
    )
    desk.dac._connect = desk.stream.connect
    with pytest.raises(LinkError, match="no Ether Dream answers at dac: Connection refused"):
        desk.dac.open()
    desk = Desk()
    desk.core.answer = lambda command, code=b"a": b"HTTP/1.1 400 Bad Request"
    with pytest.raises(LinkError, match=r"it answered b'T' to b'\?'"):
        desk.dac.open()
