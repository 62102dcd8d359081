"""Session over USB: the real pyusb with bulk endpoints of a simulated board core."""

import errno
from typing import get_args

import pytest
import usb.core
from usb_bridge import UsbBridge

from displays import DISPLAYS
from optodrive.core.clock import ManualClock
from optodrive.core.errors import InputError, LinkError
from optodrive.device.config_sections import BoardSection
from optodrive.link.board_setup import build_board_requirements, build_port_settings
from optodrive.link.protocol.quantisation import quantise
from optodrive.link.session.session import BoardSession
from optodrive.link.simulator.board_core import BoardCore
from optodrive.link.transport.registry import find_transport_factory, iterate_transports
from optodrive.link.transport.usb_bulk import UsbBulk
from optodrive.planning.pipeline import plan_sequence

STEP_S = 0.005
DISPLAY = DISPLAYS["display-16"]


class Rig:
    def __init__(self, serial_number="", **bridge):
        self.clock, self.log = ManualClock(5.0), []
        self.core = BoardCore(sink=self.log.append, seed=2)
        self.usb = UsbBridge(self.core, self.clock, **bridge)
        self.link = UsbBulk(0x1209, 0x0001, serial_number, self.usb)
        self.session = BoardSession(self.link, self.clock, build_board_requirements(DISPLAY.config))

    def until(self, condition, patience_s=20.0, lease=True):
        give_up_s = self.clock.now_s() + patience_s
        while not condition():
            assert self.clock.now_s() < give_up_s, f"timed out: {self.session.board}"
            self.session.step(STEP_S, lease)

    def streaming(self):
        """Connect, arm and start a plan. Return while it is running."""
        from optodrive.core.types.stimuli import FrameSequence, PulseTrain

        sequence = FrameSequence(trains=(PulseTrain(5, 0.0, 1.0, 0.004, 0.02, 1.0),))
        self.plan = plan_sequence(DISPLAY, sequence, *DISPLAY.build_cold_state()).plan
        self.session.connect()
        self.session.arm()
        self.until(lambda: self.session.is_ready)
        points = quantise(self.plan, self.session.scale)
        self.job = self.session.begin(points, self.session.board_s() + 0.05)
        self.until(lambda: len(self.pulses()) > 5)
        return self

    def pulses(self):
        return [entry for entry in self.log if entry["event"] == "pulse"]


def test_a_plan_is_armed_streamed_and_reported_over_usb():
    rig = Rig().streaming()
    rig.until(lambda: rig.job.is_finished)
    scale = rig.session.scale
    executed = rig.job.build_executed(rig.plan, scale)
    assert executed.complete
    assert executed.start_s == pytest.approx(rig.plan.start_s)
    rig.session.close()
    assert rig.core.state == "DISARMED"
    assert not rig.usb.claimed


def test_unplugging_during_a_plan_turns_the_gate_off_and_is_reported():
    rig = Rig().streaming()
    rig.usb.unplug()
    with pytest.raises(LinkError, match=r"link to usb 1209:0001 lost: .*unplugged, reset or without power"):
        rig.session.step(STEP_S, renew_lease=True)
    rig.session.disconnect()
    assert not rig.core.gate
    assert rig.core.state == "DISARMED"
    with pytest.raises(InputError, match="a connected USB device"):
        rig.session.connect()
    rig.usb.plugged = True
    rig.session.connect()
    assert rig.session.board.state == "DISARMED"


def test_the_lease_ends_emission_after_the_host_released_the_device():
    rig = Rig().streaming()
    rig.link.close()
    rig.clock.sleep(DISPLAY.config.board.lease_s + 1e-3)
    rig.core.advance(round(rig.clock.now_s() * 1e6))
    assert not rig.core.gate
    assert rig.core.fault == "LINK"


def test_bytes_of_a_previous_session_are_discarded():
    rig = Rig()
    rig.usb.waiting = b"old" * 5000
    rig.link.open()
    assert rig.link.read(0.01) == b""


def test_a_board_that_accepts_no_bytes_is_a_lost_link():
    rig = Rig()
    rig.link.open()
    rig.usb.stalled = True
    began_s = rig.clock.now_s()
    with pytest.raises(LinkError, match="accepts no bytes"):
        rig.link.write(b"x")
    assert rig.clock.now_s() - began_s == pytest.approx(0.5)


def test_a_partial_write_is_a_lost_link():
    rig = Rig()
    rig.link.open()
    rig.usb.bulk_write = lambda *transfer: 1
    with pytest.raises(LinkError, match="accepted 1 of 3 bytes"):
        rig.link.write(b"abc")


def test_the_serial_number_selects_one_of_several_boards():
    with pytest.raises(InputError, match="2 times 1209:0001', expected one such USB device, or its serial_number"):
        Rig(serials=("A1", "B2")).link.open()
    rig = Rig("B2", serials=("A1", "B2"))
    rig.link.open()
    assert rig.usb.claimed == {(1, 1)}
    assert rig.link.name == "usb 1209:0001 B2"
    with pytest.raises(InputError, match=r"got 'C3', expected that of a connected 1209:0001: .*'A1', .*'B2'"):
        Rig("C3", serials=("A1", "B2")).link.open()


def test_the_reason_for_a_failed_open_is_reported():
    rig = Rig()
    rig.usb.open_errno = errno.EACCES
    with pytest.raises(InputError, match="udev rule"):
        rig.link.open()
    rig = Rig()
    rig.usb.claim_errno = errno.EBUSY
    with pytest.raises(LinkError, match="another program has it open"):
        rig.link.open()
    rig = Rig(one_way=True)
    with pytest.raises(InputError, match="a bulk endpoint in each direction"):
        rig.link.open()
    with pytest.raises(LinkError, match="not open"):
        rig.link.read(0.0)
    rig.link.close()


def test_a_missing_libusb_is_reported(monkeypatch):
    def none(**_):
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", none)
    with pytest.raises(InputError, match=r"libusb-1\.0-0"):
        UsbBulk(1, 2).open()


def find_factory(**board):
    config = DISPLAYS["display-16"].config
    return find_transport_factory(build_port_settings(config.model_copy(update={"board": BoardSection(**board)})))


def test_the_registry_builds_the_configured_transport():
    usb_board = find_factory(transport="usb", vendor_id=0x1209, product_id=1, serial_number="A1")
    assert usb_board().name == "usb 1209:0001 A1"
    assert find_factory(transport="serial", port="/dev/ttyX")().name == "/dev/ttyX"
    stated = get_args(BoardSection.model_fields["transport"].annotation)
    assert {kind.name for kind in iterate_transports()} == set(stated)
    dac_board = find_factory(transport="idn", port="dac", interlock_watched=True)()
    assert dac_board.name == "idn dac"
    dac_board.release()
    with pytest.raises(InputError, match="true once an external interlock cuts the laser"):
        find_factory(transport="helios")
