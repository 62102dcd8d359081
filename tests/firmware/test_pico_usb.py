"""The Pico's own USB port in the emulator: a second port of the same image, in the emulator's time.

The conformance suite plays what a port can change over it with --slow. The computer at the port is rp2040js's, on a
bus that `usb.mjs` completes.
"""

import shutil
import struct
from functools import partial
from random import Random

import pytest
from bench import BRIGHT, Bench, here
from emulated_pico import HOST_CLOSED, LOOP_US, PORT, EmulatedPico, PicoImage
from emulated_usb_pico import SEND_BREAK, EmulatedUsbPico
from virtual_board import PicoBoard, VirtualKind
from wire_format import HOST, MessageReader, body_of, frame

from optodrive.cli.doctor_bare_board import check_bare_board
from optodrive.core.clock import ManualClock
from optodrive.link.simulator.virtual_run import MemoryLink

BUS_LOST_US = 4000
"""The board notices within this time that no frame begins any more."""
TURN_US = 500
"""The main loop notices within this time what the computer does."""
BUS_RESET_US = 10_000
BOOT_US = 50_000
NONSENSE = 400
GAP_MAX_US = 600
SET_CONFIGURATION_0 = bytes.fromhex("0009000000000000")
LOSSES = {
    "closed": lambda core: core.usb("close"),
    "suspended": lambda core: core.usb("suspend"),
    "unplugged": lambda core: core.usb("unplug"),
    "reset": lambda core: core.usb("reset"),
    "deconfigured": lambda core: core.usb("control", SET_CONFIGURATION_0.hex(), ""),
    "break": lambda core: core.usb("control", SEND_BREAK.hex(), ""),
}
"""What the computer does, and the board then is dark."""
LATE_US = {"suspended": BUS_LOST_US, "unplugged": BUS_LOST_US, "reset": BUS_RESET_US}
IN_EVERY_RUN = ("unplugged",)
"""A closed port is lost in the test of two ports, too."""
CONFIGURE = "        configure((uint8_t)setup->value);\n"
RESET = "        reset_device();\n"
MUTANTS = {
    "frames are not watched": ("usb.c", "now_us - usb.frame_us < BUS_LOST_US", "true", ("suspended", "unplugged")),
    "DTR is not watched": ("usb.c", "usb.dtr = setup->value & 1u;", "usb.dtr = true;", ("closed",)),
    "a reset of the bus is ignored": (
        "usb.c", RESET, "        CLEAR(USB_SIE_STATUS) = USB_SIE_BUS_RESET;\n        if (0)\n    " + RESET, ("reset",),
    ),
    "a device stays configured": ("usb.c", CONFIGURE, "        usb.configuration = 1;\n", ("deconfigured",)),
    "a BREAK is ignored": ("usb.c", "|| setup->value != 0;", ";", ("break",)),
    "a close is no loss": ("host_port.c", "return !is_open ||", "return", ("closed", "unplugged", "suspended")),
}  # fmt: skip
"""File, text, what replaces it, and the losses that then leave the gate open."""


def make_bench(image, folder, core=EmulatedUsbPico):
    return Bench(VirtualKind("pico-usb", partial(core, image), make_board=PicoBoard), folder)


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    return PicoImage(tmp_path_factory.mktemp("pico-usb"))


@pytest.fixture
def bench(image, tmp_path):
    bench = make_bench(image, tmp_path)
    yield bench
    bench.finish(lambda board: None)


def lose(bench, loss):
    """Let a lit board lose its computer. Return after how many µs its gate turned off."""
    host = bench.ready(**BRIGHT)
    host.shine(seconds=1)
    core, now_us = host.board.core, host.clock.now_us()
    core.advance(now_us)
    LOSSES[loss](core)
    core.advance(now_us + 2 * BUS_RESET_US)
    off_us, on, _ = core.pins[-1]
    assert not on
    assert host.board.states()[-1] == ("DISARMED", "link lost")
    assert off_us - now_us <= TURN_US + LATE_US.get(loss, 0)
    return off_us - now_us


@pytest.mark.slow
def test_a_job_over_usb_is_emitted_as_sent(bench):
    host = bench.ready(**BRIGHT)
    points = [here(500, dark_us=300, x=30_000 + 100 * k) for k in range(60)]
    assert host.play(*points) == []
    host.wait_for_change("job done")
    assert [(p["x"], p["off_us"] - p["on_us"]) for p in host.board.of("pulse")] == [
        (x, on) for x, _, _, on, _ in points
    ]


@pytest.mark.parametrize(
    "loss", [loss if loss in IN_EVERY_RUN else pytest.param(loss, marks=pytest.mark.slow) for loss in LOSSES]
)
def test_each_loss_of_the_computer_turns_the_gate_off(bench, loss):
    print(f"{loss}: gate off after {lose(bench, loss):.0f} µs")


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", MUTANTS)
def test_a_port_that_misses_a_loss_is_detected(name, tmp_path):
    file, text, instead, losses = MUTANTS[name]
    source = tmp_path / "firmware_protocol"
    shutil.copytree(PORT.parents[1], source)
    port, built = source / "ports" / PORT.name, tmp_path / "built"
    built.mkdir()
    code = (port / file).read_text()
    assert code.count(text) == 1
    (port / file).write_text(code.replace(text, instead))
    image = PicoImage(built, port=port)
    for loss in losses:
        bench = make_bench(image, tmp_path)
        with pytest.raises(AssertionError):
            lose(bench, loss)
        bench.finish(lambda board: None)


def test_the_device_answers_a_computer_s_requests(image):
    core = EmulatedUsbPico(image, None, lambda event: None)
    core.advance(30_000)
    device = core.request(bytes.fromhex("8006000100004000"))
    assert (len(device), device[:2], device[7]) == (18, b"\x12\x01", 64)
    configuration = core.request(bytes.fromhex("800600020000ff00"))
    assert struct.unpack_from("<H", configuration, 2) == (len(configuration),) == (75,)
    assert core.request(bytes.fromhex("8006000200000900")) == configuration[:9]
    at, kinds = 0, []
    while at < len(configuration):
        kinds.append(configuration[at + 1])
        at += configuration[at]
    assert (at, kinds.count(4), kinds.count(5)) == (75, 2, 3)
    texts = [core.request(bytes([0x80, 6, number, 3, 9, 4, 255, 0])) for number in (1, 2, 3)]
    assert [text[2:].decode("utf-16-le") for text in texts] == [
        "optodrive", "optodrive board", b"rp2040-00001".hex(),
    ]  # fmt: skip
    assert core.request(bytes.fromhex("8006040309040ff0")) is None, "no such string"
    assert core.request(bytes.fromhex("8006000600000a00")) is None, "no descriptor of a faster bus"
    assert core.request(bytes.fromhex("8000000000000200")) == bytes(2)
    assert core.request(bytes.fromhex("8008000000000100")) == b"\x01"
    assert core.request(bytes.fromhex("2120000000000700"), b"\x40\x42\x0f\x00\x00\x00\x08") == b""
    assert core.request(bytes.fromhex("a121000000000700")) == b"\x40\x42\x0f\x00\x00\x00\x08"
    assert core.request(bytes.fromhex("c000000000000000")) is None, "no request of a vendor"
    core.close()


def test_the_packets_count_anew_after_a_cleared_endpoint(bench):
    host = bench.greeted()
    core = host.board.core
    for endpoint in (0x02, 0x82):
        host.status()
        assert core.request(bytes([0x02, 1, 0, 0, endpoint, 0, 0, 0])) == b""
    assert host.status().state == "DISARMED"


def test_a_host_that_does_not_read_delays_nothing_and_loses_whole_frames(bench):
    host = bench.ready(queue_points=2048, **BRIGHT)
    core = host.board.core
    points = [here(200, dark_us=300, x=20_000 + 10 * k) for k in range(600)]
    first = [host.data(*points[at : at + 24]) for at in range(0, len(points), 24)]
    assert host.order(*first) == []
    core.measure_ticks()
    core.usb("read", False)
    host.send("START", job=1, first_index=0, start_tick=0, watermark=1)
    host.send("END", job=1, end_index=len(points))
    host.wait_for_change("job done")
    _, gap_us = core.measure_ticks()
    print(f"between ticks at most {gap_us:.0f} µs")
    assert gap_us <= GAP_MAX_US
    assert host.board.pulse_numbers() == list(range(600))
    core.usb("read", True)
    host.status()  # after all that was outgoing, each frame intact
    reported = sum(len(message.records) for message in host.of("EXECUTED"))
    assert reported < 600
    host.received.clear()
    host.send("GET_EXECUTED", first_index=599)
    host.wait(lambda: host.of("EXECUTED"), "the last report")


def test_doctor_finds_the_shipped_image_in_order(image):
    log, clock = [], ManualClock()
    pico = EmulatedUsbPico(image, None, log.append)
    pico.open_port(BOOT_US)
    clock.sleep(BOOT_US * 1e-6)
    findings = {finding.check: finding for finding in check_bare_board(MemoryLink(pico, clock), clock)}
    assert {finding.status for finding in findings.values()} == {"ok"}
    assert findings["capacities"].observation == "2048 points, 2048 pulses a second, 1520 cells of 1300 codes"
    assert {entry["state"] for entry in log if entry["event"] == "state"} == {"DISARMED"}
    assert pico.pins == []
    pico.close()


@pytest.mark.slow
def test_a_replugged_board_is_greeted_and_not_armed(bench):
    host = bench.ready(**BRIGHT)
    core = host.board.core
    core.usb("unplug")
    host.wait_for_change("link lost", lease=False)
    core.usb("plug")
    core.open_port(host.clock.now_us())
    assert host.hello().reset_cause == 0
    assert host.status().state == "DISARMED"


def test_a_computer_that_asks_for_nonsense_delays_no_tick(image):
    random = Random(11)
    core = EmulatedUsbPico(image, None, lambda event: None)
    core.open_port(0)
    core.advance(BOOT_US)
    core.measure_ticks()
    for _ in range(NONSENSE):
        setup = bytearray(random.randbytes(8))
        if random.random() < 0.7:  # mostly of a kind that the device knows
            setup[0] &= 0xA1
            setup[1] = random.choice((0, 1, 5, 6, 8, 9, 10, 11, 0x20, 0x21, 0x22, 0x23))
            setup[2:6] = (random.randrange(3), random.randrange(8), random.choice((0, 1, 2, 0x82)), 0)
        core.usb("nonsense", setup.hex(), random.randbytes(random.randrange(64)).hex())
        core.usb("bytes", random.randbytes(random.randrange(200)).hex())
        core.advance(round(core.chip_us) + random.randrange(TURN_US))
    assert core.measure_ticks()[1] <= GAP_MAX_US
    core.usb("unplug")
    core.usb("plug")
    core.open_port(round(core.chip_us) + 2 * BUS_RESET_US)
    core.receive(b"\0" + HELLO, round(core.chip_us))
    core.advance(round(core.chip_us) + OPEN_US)
    assert "HELLO_REPLY" in names(core.bytes_to_send())
    assert core.pins == []
    core.close()


# --- two ports ------------------------------------------------------------------------------------------------------


HELLO = frame(HOST["HELLO"][0], body=body_of("HELLO", major=1, minor=0, host_nonce=7))
ABORT = frame(HOST["ABORT"][0])
OPEN_US = 5000


def names(data):
    return [message.name for message in MessageReader().take(data)]


class UsbBesideUart(EmulatedUsbPico):
    """A host on USB, and a second one on the adapter."""

    second = b""

    def open_second(self):
        self._command("pin", HOST_CLOSED, False)

    def send_second(self, data):
        self._command("bytes", data.hex())
        self.advance(round(self.chip_us) + OPEN_US)

    def _on_byte(self, at_us, byte):
        self.second += bytes([byte])


class UartBesideUsb(EmulatedPico):
    """A host on the adapter, and a second one on USB."""

    second = b""

    def open_second(self):
        self._command("usb", "plug")
        self._command("usb", "open")
        self.advance(round(self.chip_us) + 4 * OPEN_US)

    def send_second(self, data):
        self._command("usb", "bytes", data.hex())
        self.advance(round(self.chip_us) + OPEN_US)

    def _on_usb(self, at_us, data):
        self.second += bytes.fromhex(data)


@pytest.mark.parametrize("core", [UsbBesideUart, pytest.param(UartBesideUsb, marks=pytest.mark.slow)])
def test_the_port_that_opened_first_holds_the_board_until_it_closes(image, tmp_path, core):
    bench = make_bench(image, tmp_path, core)
    host = bench.ready(**BRIGHT)
    host.shine(seconds=1)
    chip = host.board.core
    chip.open_second()
    chip.send_second(HELLO + ABORT)
    assert host.board.states()[-1][0] == "RUNNING"
    assert host.board.is_gate_on()
    assert host.status().seq_errors == 0
    assert chip.second == b""
    host.close()
    assert host.board.states()[-1] == ("DISARMED", "link lost")
    assert not chip.pins[-1][1]
    chip.advance(round(chip.chip_us) + LOOP_US)
    chip.send_second(HELLO)
    assert names(chip.second) == ["HELLO_REPLY"]
    bench.finish(lambda board: None)
