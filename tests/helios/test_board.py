"""The driver against the emulated board, through the real pyusb."""

import errno

import pytest

from helios.bench import Bench, config_of
from helios.emulated import EmulatedHelios, HostDeadError
from optodrive.core.clock import ManualClock
from optodrive.core.errors import InputError, LinkError, LocalProtocolError
from optodrive.link.helios import dac as board_module
from optodrive.link.helios.dac import Helios
from optodrive.link.helios.frames import HeliosFrame
from optodrive.link.transport.usb_device import find_device


def frame(points=100, rate=40_000, level=0):
    import numpy as np

    table = np.zeros((points, 7), dtype=np.uint8)
    table[:-1, 3:] = level
    return HeliosFrame.from_points(table, rate)


def test_opened_it_is_known_and_dark():
    bench = Bench(name="Helios 77", version=6)
    with bench.helios as helios:
        assert (helios.version, helios.name) == (6, "Helios 77")
        assert bench.device.host_version == board_module.PROTOCOL_VERSION
        assert not bench.device.shutter
        assert bench.clock.now_s() >= board_module.ENABLE_DELAY_S + board_module.STOP_DELAY_S
    assert bench.emulated.alternate == 0


def test_a_stale_answer_is_drained_before_the_questions():
    bench = Bench()
    bench.device.answer = b"\x83\x01"
    with bench.helios as helios:
        assert helios.version == 6


def test_the_version_is_asked_twice_and_waited_for_three_times_each():
    bench = Bench()
    bench.emulated.deaf = 5  # the answer is there, and five reads miss it
    with bench.helios as helios:
        assert helios.version == 6
    bench = Bench()
    bench.emulated.deaf = 6
    with pytest.raises(LinkError, match="does not answer question 4"):
        bench.helios.open()
    assert bench.emulated.commands.count(b"\x04\x00") == 2
    assert not bench.emulated.claimed


def test_another_helios_than_the_configured_one_is_refused():
    bench = Bench(config_of(uid="Helios 1").board, name="Helios 2")
    with pytest.raises(InputError, match=r"board\.uid: got 'Helios 2', expected Helios 1"):
        bench.helios.open()
    assert not bench.device.shutter
    assert not bench.emulated.claimed


@pytest.mark.parametrize(
    ("others", "plugged", "words"),
    [(("helios two",), True, "2 times 1209:e500"), ((), False, "connected"), (((1, 2),), True, None)],
)
def test_it_must_be_there_and_the_only_one(others, plugged, words):
    emulated = EmulatedHelios(ManualClock(), others=others)
    if not plugged:
        emulated.unplugged_at_s = 0.0
    if words is None:
        assert find_device(0x1209, 0xE500, backend=emulated) is not None
        return
    with pytest.raises(InputError, match=words):
        find_device(0x1209, 0xE500, backend=emulated)


def test_without_permission_it_says_so():
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


def test_no_answer_is_not_ready_and_a_late_one_is_not_taken_for_the_next():
    bench = Bench()
    with bench.helios as helios:
        helios.open_shutter()
        bench.emulated.deaf = 1
        assert helios.is_ready() is False  # the answer "ready" is still on its way
        helios.send(frame(900))
        helios.send(frame(900))
        assert helios.is_ready() is False  # now a frame waits: the late answer would lie


@pytest.mark.parametrize("board", [{"interlock_watched": False}, {"transport": "simulated"}])
def test_without_a_watched_interlock_nothing_is_emitted(board):
    config = config_of().board.model_copy(update=board)
    bench = Bench(config)
    with bench.helios as helios:
        with pytest.raises(InputError, match=r"board\.interlock_watched: got"):
            helios.open_shutter()
        with pytest.raises(InputError, match="interlock_watched"):
            helios.send(frame())
    assert not bench.emulated.transfers
    assert not any(output.shutter for output in bench.device.log)


def test_no_frame_leaves_that_was_not_checked():
    bench = Bench()
    whole = frame()
    with bench.helios as helios, pytest.raises(LocalProtocolError, match="play once"):
        helios.send(HeliosFrame(whole.data[:-1] + b"\0", whole.duration_s))
    assert not bench.emulated.transfers


@pytest.mark.parametrize("command", [0xDE, 0x06, 0x00, 0xFF])
def test_a_command_that_writes_to_flash_is_never_sent(command):
    bench = Bench()
    with bench.helios as helios, pytest.raises(LocalProtocolError, match="none that this driver sends"):
        helios._command(command, 0)
    assert not bench.device.erased
    assert all(sent[0] in (1, 2, 3, 4, 5, 7) for sent in bench.emulated.commands)


class OddError(Exception):
    pass


@pytest.mark.parametrize("error", [OddError, KeyboardInterrupt, SystemExit, LinkError])
def test_left_by_any_exception_it_is_stopped_and_shut(error):
    bench = Bench()

    def use():
        with bench.helios as helios:
            helios.open_shutter()
            helios.send(frame(900, level=200))
            bench.clock.sleep(0.005)
            raise error

    with pytest.raises(error):
        use()
    light = bench.device.light()
    assert light
    assert bench.device.dark_from_s() < bench.clock.now_s() - board_module.STOP_DELAY_S + 0.01
    assert not bench.device.shutter
    assert bench.device.colour == (0, 0, 0, 0)


def test_a_stop_that_is_not_heard_at_once_is_said_again():
    bench = Bench()
    with bench.helios as helios:
        helios.open_shutter()
        bench.emulated.refused = 2
    assert not bench.device.shutter


def test_a_stop_that_is_not_heard_at_all_is_told_and_the_board_let_go():
    bench = Bench()
    helios = bench.helios
    helios.open()
    helios.open_shutter()
    helios.send(frame(900, level=200))
    bench.emulated.refused = 100
    with pytest.raises(LinkError, match="may not have heard to stop"):
        helios.close()
    assert not bench.device.connected  # the alternate setting without endpoints stopped it
    assert not bench.emulated.claimed


def test_an_unplugged_board_is_told_and_closes_without_a_fuss():
    bench = Bench()
    bench.helios.open()
    bench.emulated.unplugged_at_s = bench.clock.now_s()
    with pytest.raises(LinkError, match="unplugged"):
        bench.helios.is_ready()
    with pytest.raises(LinkError, match="may not have heard"):
        bench.helios.close()
    with pytest.raises(LinkError, match="not open"):
        bench.helios.is_ready()


def test_a_dead_host_leaves_the_shutter_as_it_was_and_a_new_one_closes_it():
    bench = Bench()
    bench.helios.open()
    bench.helios.open_shutter()
    bench.emulated.dies_at_s = bench.clock.now_s()
    with pytest.raises(HostDeadError):
        bench.helios.is_ready()
    bench.emulated.dies_at_s = float("inf")
    assert bench.device.shutter
    with Helios(config_of().board, bench.clock, bench.emulated):
        assert not bench.device.shutter
