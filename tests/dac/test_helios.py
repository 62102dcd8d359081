"""Driver against the emulated DAC through the real pyusb."""

import errno

import pytest

from dac.bench import Bench, build_config
from dac.emulated_helios import EmulatedHelios, HostDeadError
from optodrive.core.clock import ManualClock
from optodrive.core.errors import InputError, LinkError, LocalProtocolError
from optodrive.link.dac.devices import helios as dac_module
from optodrive.link.dac.devices.helios import Helios
from optodrive.link.dac.formats.base import Chunk
from optodrive.link.dac.formats.helios import HeliosFormat
from optodrive.link.transport.usb_bulk import find_device


def frame(points=100, rate=40_000, level=0):
    import numpy as np

    table = np.zeros((points, 3), dtype=np.int64)
    table[:-1, 2] = level
    return HeliosFormat(rate).check(HeliosFormat(rate).pack(table, 0))


def test_open_identifies_and_stops_the_dac():
    bench = Bench(name="Helios 77", version=6)
    with bench.helios as helios:
        assert (helios.firmware, helios.name) == ("6", "Helios 77")
        assert bench.device.host_version == dac_module.PROTOCOL_VERSION
        assert not bench.device.shutter
        assert bench.clock.now_s() >= dac_module.ENABLE_DELAY_S + dac_module.STOP_DELAY_S
    assert bench.emulated.alternate == 0


def test_a_name_that_would_clear_a_terminal_is_escaped():
    with Bench(name="Helios \x1b[2J").helios as helios:
        assert helios.name == r"Helios \x1b[2J"


def test_open_discards_a_stale_answer_before_its_queries():
    bench = Bench()
    bench.device.answer = b"\x83\x01"
    with bench.helios as helios:
        assert helios.firmware == "6"


def test_the_version_is_queried_twice_with_three_reads_each():
    bench = Bench()
    bench.emulated.deaf = 5  # five reads lose the answer
    with bench.helios as helios:
        assert helios.firmware == "6"
    bench = Bench()
    bench.emulated.deaf = 6
    with pytest.raises(LinkError, match="does not answer query 4"):
        bench.helios.open()
    assert bench.emulated.commands.count(b"\x04\x00") == 2
    assert not bench.emulated.claimed


def test_another_helios_than_the_configured_one_is_rejected():
    bench = Bench(build_config(uid="Helios 1").board, name="Helios 2")
    with pytest.raises(InputError, match=r"board\.uid: got 'Helios 1', expected .*; the connected one is 'Helios 2\'"):
        bench.helios.open()
    assert not bench.device.shutter
    assert not bench.emulated.claimed


@pytest.mark.parametrize(
    ("others", "plugged", "words"),
    [(("helios two",), True, "2 times 1209:e500"), ((), False, "connected"), (((1, 2),), True, None)],
)
def test_there_must_be_exactly_one_device(others, plugged, words):
    emulated = EmulatedHelios(ManualClock(), others=others)
    if not plugged:
        emulated.unplugged_at_s = 0.0
    if words is None:
        assert find_device(0x1209, 0xE500, backend=emulated) is not None
        return
    with pytest.raises(InputError, match=words):
        find_device(0x1209, 0xE500, backend=emulated)


def test_missing_permission_is_reported():
    bench = Bench()
    bench.emulated.open_errno = errno.EACCES
    with pytest.raises(InputError, match="udev rule"):
        bench.helios.open()


@pytest.mark.parametrize(
    ("answers", "ready"),
    [
        ([b"\x83\x01"], True),
        ([b"\x83\x00"], False),
        ([b"\x83\x02"], False),
        ([b"\x83"], False),
        ([b"\x84\x01"], False),
        ([b"\x83\x01\x00"], False),
        ([b"\xff" * 32], False),
        ([b""], False),
    ],
)
def test_only_one_answer_means_ready(answers, ready):
    bench = Bench()
    with bench.helios as helios:
        bench.emulated.garbage.extend(answers)
        assert helios.is_ready() is ready
        assert helios.is_ready() is True


def test_a_missing_answer_is_not_ready_and_a_late_one_is_discarded():
    bench = Bench()
    with bench.helios as helios:
        helios.start()
        bench.emulated.deaf = 1
        assert helios.is_ready() is False  # the answer "ready" is still in transit
        helios.send(frame(900))
        helios.send(frame(900))
        assert helios.is_ready() is False  # a frame is queued now, so the late answer is outdated


@pytest.mark.parametrize("board", [{"interlock_watched": False}, {"transport": "simulated"}])
def test_without_an_external_interlock_nothing_is_emitted(board):
    config = build_config().board.model_copy(update=board)
    bench = Bench(config)
    with bench.helios as helios:
        with pytest.raises(InputError, match=r"board\.interlock_watched: got"):
            helios.start()
        with pytest.raises(InputError, match="interlock_watched"):
            helios.send(frame())
    assert not bench.emulated.transfers
    assert not any(output.shutter for output in bench.device.log)


def test_send_validates_the_frame():
    bench = Bench()
    whole = frame()
    with bench.helios as helios, pytest.raises(LocalProtocolError, match="play once"):
        helios.send(Chunk(whole.data[:-1] + b"\0", whole.points, whole.duration_s))
    assert not bench.emulated.transfers


@pytest.mark.parametrize("command", [0xDE, 0x06, 0x00, 0xFF])
def test_a_command_that_writes_to_flash_is_never_sent(command):
    bench = Bench()
    with bench.helios as helios, pytest.raises(LocalProtocolError, match="not one that this driver sends"):
        helios._command(command, 0)
    assert not bench.device.erased
    assert all(sent[0] in (1, 2, 3, 4, 5, 7) for sent in bench.emulated.commands)


class OddError(Exception):
    pass


@pytest.mark.parametrize("error", [OddError, KeyboardInterrupt, SystemExit, LinkError])
def test_any_exception_stops_the_dac_and_closes_the_shutter(error):
    bench = Bench()

    def use():
        with bench.helios as helios:
            helios.start()
            helios.send(frame(900, level=200))
            bench.clock.sleep(0.005)
            raise error

    with pytest.raises(error):
        use()
    light = bench.device.light()
    assert light
    assert bench.device.dark_from_s() < bench.clock.now_s() - dac_module.STOP_DELAY_S + 0.01
    assert not bench.device.shutter
    assert bench.device.colour == (0, 0, 0, 0)


def test_a_refused_stop_is_repeated():
    bench = Bench()
    with bench.helios as helios:
        helios.start()
        bench.emulated.refused = 2
    assert not bench.device.shutter


def test_a_failed_stop_is_reported_and_the_device_released():
    bench = Bench()
    helios = bench.helios
    helios.open()
    helios.start()
    helios.send(frame(900, level=200))
    bench.emulated.refused = 100
    with pytest.raises(LinkError, match="may not have received the stop"):
        helios.close()
    assert not bench.device.connected  # the alternate setting without endpoints stopped it
    assert not bench.emulated.claimed


def test_an_unplugged_device_is_reported_and_can_be_closed():
    bench = Bench()
    bench.helios.open()
    bench.emulated.unplugged_at_s = bench.clock.now_s()
    with pytest.raises(LinkError, match="unplugged"):
        bench.helios.is_ready()
    with pytest.raises(LinkError, match="may not have received"):
        bench.helios.close()
    with pytest.raises(LinkError, match="not open"):
        bench.helios.is_ready()


def test_a_killed_host_leaves_the_shutter_open_and_the_next_one_closes_it():
    bench = Bench()
    bench.helios.open()
    bench.helios.start()
    bench.emulated.dies_at_s = bench.clock.now_s()
    with pytest.raises(HostDeadError):
        bench.helios.is_ready()
    bench.emulated.dies_at_s = float("inf")
    assert bench.device.shutter
    with Helios(build_config().board, bench.clock, bench.emulated):
        assert not bench.device.shutter
