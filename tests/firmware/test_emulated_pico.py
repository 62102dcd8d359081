"""The UF2 of the Raspberry Pi Pico in an emulator of its chip, judged by its pins in the emulator's time.

The conformance suite plays the scenarios of B1 to B15 on it with --slow; here, the image's own settings, and what
only pins show.
"""

from functools import partial

import numpy as np
import pytest
from bench import BRIGHT, CENTRE, PATIENT, Bench, act, here, set_input
from emulated_pico import PWM_STEPS, EmulatedPico, PicoImage
from emulated_usb_pico import EmulatedUsbPico
from virtual_board import PicoBoard, VirtualKind

TICK_US = 100
LATE_MAX_US = 100
"""B2: the gate turns off at most this long after its time."""
WATCHDOG_US = 40_000
DAC_SETUP = [(0x28, 1), (0x38, 1), (0x02, 3), (0x30, 3)]
"""Reset, reference on, gain 1, pin LDAC ignored."""
QUEUE_POINTS, RATE_HZ = 2048, 2000
FLOOD_FRAMES = 20


@pytest.fixture(scope="session")
def image(tmp_path_factory):
    return PicoImage(tmp_path_factory.mktemp("pico"))


@pytest.fixture(params=[EmulatedPico])
def bench(image, tmp_path, request):
    bench = Bench(VirtualKind("pico", partial(request.param, image), make_board=PicoBoard), tmp_path)
    yield bench
    bench.finish(lambda board: None)


@pytest.fixture
def shipped(image, tmp_path):
    """Return a bench of boards with the settings of the image."""

    def make_core(settings, sink, seed):
        return EmulatedPico(image, None, sink, seed)

    bench = Bench(VirtualKind("pico", make_core, make_board=PicoBoard), tmp_path)
    yield bench
    bench.finish(lambda board: None)


def check_edges(core, board):
    """Check the pin against the log: never early, off at most LATE_MAX_US late. Return its lateness, µs."""
    logged, pins = board.of("gate"), core.pins
    assert [on for _, on, _ in pins] == [entry["on"] for entry in logged]
    late_us = np.array([at_us for at_us, _, _ in pins]) - [entry["t_us"] for entry in logged]
    assert late_us.min() >= 0
    assert late_us[1::2].max() <= LATE_MAX_US
    return late_us


def test_the_image_as_built_boots_arms_and_emits_what_it_is_sent(shipped):
    board = shipped.board(set_input("key", False), set_input("key", True))
    host = shipped.host(board)
    reply = host.hello()
    core = board.core
    assert [word[1:] for word in core.dac] == DAC_SETUP
    assert (bytes(reply.uid), reply.capabilities, reply.cells, reply.window_pulses) == (b"rp2040-00001", 1, 1520, 2048)
    assert host.send_checked("ARM_REQ", host_nonce=1) == ["KEY_EDGE"]
    for _ in range(2):
        board.next_step()
        host.pause(0.01)
    host.send_checked("CLEAR_FAULT")
    host.arm()
    points = [
        here(300 + k, x=CENTRE + 2000 * k, y=CENTRE - 3000 * k, duty=65535 - 9000 * k, dark_us=100) for k in range(6)
    ]
    assert host.play(*points) == []
    host.wait_for_change("job done")
    pulses = board.of("pulse")
    assert [(p["x"], p["y"], p["duty"], p["off_us"] - p["on_us"]) for p in pulses] == [
        (x, y, duty, on_us) for x, y, _, on_us, duty in points
    ]
    assert [compare for _, on, compare in core.pins if on] == [point[4] * PWM_STEPS // 65535 for point in points]
    check_edges(core, board)


def test_the_watchdog_turns_the_gate_off_within_40_ms(bench):
    host = bench.ready(act("stop_loop"), **BRIGHT)
    host.shine(seconds=1)
    host.board.next_step()
    core, stopped_us = host.board.core, host.clock.now_us()
    host.board.wait(lambda: host.board.states()[-1] == ("DISARMED", "boot"), "the reset")
    off_us, on, _ = core.pins[-1]
    assert not on
    # The next tick feeds it once more, for the loop's last turn.
    assert off_us - stopped_us <= WATCHDOG_US + 3 * TICK_US
    print(f"gate off {(off_us - stopped_us) * 1e-3:.1f} ms after the main loop stopped")


@pytest.mark.slow
def test_a_link_lost_or_broken_turns_the_gate_off_in_a_tick(bench):
    host = bench.ready(**BRIGHT)
    host.shine(seconds=1)
    core, now_us = host.board.core, host.clock.now_us()
    core.send_break(now_us)
    core.advance(now_us + 1000)
    assert host.board.states()[-1] == ("DISARMED", "link lost")
    assert core.pins[-1][0] - now_us <= 400, "the time of a byte, of the receiver's time-out and of a turn of the loop"


def flood(host, name):
    """Send as many frames as a packet of USB and the window of the UART hold, whose answers nobody waits for.

    name: of requests, or DATA, whose last frame is repeated: it is answered each time and carried out once
    """
    fields = [{"host_t": k} for k in range(FLOOD_FRAMES)]
    if name == "DATA":
        repeated = {"seq": (host.seq - 1) % 256, "first_index": 0, "points": [here(100, duty=999)] * 24}
        fields = [repeated] * FLOOD_FRAMES
    host.board.core.receive(b"".join(host.frame(name, **each) for each in fields), host.clock.now_us())


@pytest.mark.slow
@pytest.mark.parametrize("bench", [EmulatedPico, EmulatedUsbPico], ids=["uart", "usb"], indirect=True)
@pytest.mark.parametrize("floods", ["", "CLOCK", "DATA"])
def test_ticks_keep_their_time_at_a_full_queue_and_2000_pulses_a_second(bench, floods):
    tables = dict(queue_points=QUEUE_POINTS, spot_leak_uw=4_000_000_000)
    host = bench.ready(settle_us=0, settle_ns_per_code=0, **tables, **PATIENT)  # its lease may wait behind a flood
    core = host.board.core
    points = [
        here(100, x=1000 + 1600 * (k % 39), y=1000 + 1600 * (k // 39 % 39), duty=999, dark_us=400) for k in range(4096)
    ]
    first = [host.data(*points[at : at + 24]) for at in range(0, QUEUE_POINTS - 24, 24)]
    assert host.order(*first) == []
    core.measure_ticks()
    host.send("START", job=1, first_index=0, start_tick=0, watermark=1)
    more, since_s = len(first) * 24, host.clock.now_s()
    while host.clock.now_s() < since_s + 1.0:
        host.lease()
        if floods:
            flood(host, floods)
        host.receive()
        while more + 24 <= len(host.board.of("pulse")) + QUEUE_POINTS and more + 24 <= len(points):
            host.raw(host.data(*points[more : more + 24]))
            more += 24
    tick_us, gap_us = core.measure_ticks()
    assert len(host.board.of("pulse")) > 0.9 * RATE_HZ
    assert host.board.faults() == []
    print(f"tick at most {tick_us:.1f} µs, between ticks at most {gap_us:.1f} µs")
    late_us = check_edges(core, host.board)
    for name, side in (("on", late_us[::2]), ("off", late_us[1::2])):
        print(f"pin {name}: median {np.median(side):.0f} µs, at most {side.max():.0f} µs late, {len(side)} edges")
    assert gap_us <= TICK_US + 500
    used, available = core.measure_stack()
    print(f"stack {used} of {available} bytes")
    assert 0 < used < available // 2
