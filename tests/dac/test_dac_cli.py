"""`optodrive dac` on the emulated DAC, through the real pyusb, in virtual time."""

import json
import resource
import signal
from pathlib import Path

import pytest
import usb.backend.libusb1

from dac.bench import Bench, build_display, build_frame, build_train, record_cold
from dac.emulated_helios import HostDeadError
from optodrive.cli import dac as dac_cli
from optodrive.cli.invocation import DOES_NOT_FIT
from optodrive.cli.main import run
from optodrive.core.errors import LinkError
from optodrive.device.config_file import locate_shipped
from optodrive.link.dac import discovery
from optodrive.link.dac.discovery import FoundDac
from optodrive.planning import heat_record
from optodrive.planning.stimuli.sequence_file import sequence_to_json

UP_S = 1e5
LONG = build_train(width_s=0.04, gap_s=0.004, power_w=2.0, duration_s=1.0)


class Desk:
    """Folder with a configuration and frames, and the emulated DAC in place of libusb."""

    def __init__(self, folder, monkeypatch):
        self.folder, self.bench = folder, Bench()
        self.clock = self.bench.clock
        record_cold(build_display(), "helios", "any")
        monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: self.bench.emulated)
        monkeypatch.setattr("optodrive.core.clock.MonotonicClock", lambda: self.clock)
        monkeypatch.setattr(heat_record, "read_boot", lambda: ("a run", UP_S + self.clock.now_s()))
        self.frames = folder / "frames.json"
        self.ask(build_frame(build_display()))

    def ask(self, sequence):
        self.frames.write_text(json.dumps(sequence_to_json(sequence)))

    def config(self, watched="true", steps=2047):
        text = locate_shipped("display-16.toml").read_text()
        text = text.replace('transport = "simulated"', f'transport = "helios"\ninterlock_watched = {watched}')
        path = self.folder / "helios.toml"
        path.write_text(text.replace("[scanner]", f"[scanner]\nhalf_range_codes = {steps}"))
        return ["--config", str(path)]

    def play(self, *options):
        return run(["dac", "play", str(self.frames), *self.config(), *options])


@pytest.fixture
def desk(tmp_path, monkeypatch):
    return Desk(tmp_path, monkeypatch)


def test_info_reports_identity_and_permission_to_emit(desk, capsys):
    assert run(["dac", "info", *desk.config(), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "device": "Helios",
        "name": "Helios 1163021877",
        "firmware": "6",
        "ready": True,
        "may_emit": True,
        "heat": "recorded",
    }
    assert run(["dac", "info", *desk.config("false")]) == 0
    assert "may emit         no" in capsys.readouterr().out


def test_list_shows_what_is_on_usb_and_in_the_network(desk, capsys, monkeypatch):
    monkeypatch.setattr(discovery, "find_idn_devices", lambda clock: [])
    found = FoundDac("ether_dream", "00:04:a3:01:02:03", "192.168.1.20", "revision 1.0, idle")
    monkeypatch.setattr(discovery, "find_ether_dreams", lambda clock: [found])
    assert run(["dac", "list"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "helios                        Helios: USB bus 1 device 7, without serial_number; `info` asks for its name",
        "ether_dream  192.168.1.20     00:04:a3:01:02:03: revision 1.0, idle",
    ]
    desk.bench.emulated.unplugged_at_s = 0.0
    monkeypatch.setattr(discovery, "find_ether_dreams", lambda clock: [])
    assert run(["dac", "list"]) == 0
    assert capsys.readouterr().out == "no laser DAC found\n"


def test_play_reports_what_the_laser_emitted(desk, capsys):
    assert desk.play("--json") == 0
    report = json.loads(capsys.readouterr().out)
    light = desk.bench.device.light()
    playback = report["dac"]
    assert len(light) >= report["pulses"] > 0
    shone_j = sum((end_s - begin_s) * level / 255 * 2.45 for begin_s, end_s, _, _, level in light)
    assert playback["energy_j"] == pytest.approx(shone_j, rel=1e-6)
    assert 0.9 * playback["energy_planned_j"] < playback["energy_j"] <= playback["energy_planned_j"]
    assert playback["predicted_max_um"] < report["predicted_max_um"]
    assert (playback["underruns"], playback["chunks"]) == (0, desk.bench.device.frames_played)
    assert playback["points_per_s"] == pytest.approx(39_985.72, abs=0.01)
    assert not desk.bench.device.shutter
    assert not desk.bench.emulated.claimed
    assert desk.play() == 0
    assert "points/s" in capsys.readouterr().out


@pytest.mark.parametrize("after", ["at once", "killed"])
def test_a_play_accounts_for_the_heat_of_the_previous_one(desk, capsys, after):
    desk.ask(LONG)
    assert desk.play("--json") == DOES_NOT_FIT  # the caps trim it
    first = json.loads(capsys.readouterr().out)
    if after == "killed":
        desk.bench.emulated.dies_at_s = desk.clock.now_s() + 0.5
        with pytest.raises(HostDeadError):
            desk.play("--json")
        desk.bench.emulated.dies_at_s = float("inf")
    assert desk.play("--json") == DOES_NOT_FIT  # the caps trim it
    again = json.loads(capsys.readouterr().out)
    assert again["headroom_min_k"] <= first["headroom_min_k"]
    assert again["energy_j"] < first["energy_j"]


def test_without_an_external_interlock_one_line_and_no_emission(desk, capsys):
    assert run(["dac", "play", str(desk.frames), *desk.config("false")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("optodrive: board.interlock_watched: got False, expected true")
    assert error.count("\n") == 1
    assert not desk.bench.emulated.commands


@pytest.mark.parametrize("command", ["info", "play"])
def test_a_board_is_no_dac(desk, capsys, command):
    assert run(["dac", command, *([str(desk.frames)] if command == "play" else [])]) == 2
    assert "board.transport: got 'simulated', expected that of a laser DAC: helios" in capsys.readouterr().err


def test_another_converter_width_is_rejected(desk, capsys):
    assert run(["dac", "play", str(desk.frames), *desk.config(steps=32767)]) == 2
    assert "scanner.half_range_codes: got 32767, expected 2047" in capsys.readouterr().err


@pytest.mark.parametrize("number", dac_cli.TERMINATING_SIGNALS)
def test_a_signal_ends_emission_by_a_stop(desk, capsys, number):
    desk.ask(LONG)
    emulated, sent = desk.bench.emulated, []
    write = emulated.bulk_write

    def write_and_signal(*transfer):
        sent.append(emulated.clock.now_s())
        if len(sent) == 3:
            signal.raise_signal(number)
            signal.raise_signal(number)  # a second one before the first is handled
        return write(*transfer)

    emulated.bulk_write = write_and_signal
    before = signal.getsignal(number)
    assert desk.play() == 130
    assert len(sent) == 3
    assert capsys.readouterr().err == f"optodrive: terminated by {number.name}\n"
    assert emulated.commands[-2:] == [b"\x01\x00", b"\x02\x00"]
    assert desk.bench.device.dark_from_s() <= sent[-1] + 0.02
    assert not desk.bench.device.shutter
    assert signal.getsignal(number) is before


def test_unplugging_during_playback_is_one_line_and_ends_emission(desk, capsys):
    desk.ask(LONG)
    desk.bench.emulated.unplugged_at_s = desk.clock.now_s() + 0.8
    assert desk.play() == LinkError.exit_status
    error = capsys.readouterr().err
    assert "unplugged" in error
    assert error.count("\n") == 1
    assert desk.bench.device.light()
    assert desk.bench.device.dark_from_s() <= desk.bench.emulated.unplugged_at_s
    assert not desk.bench.device.shutter


def test_a_record_that_cannot_be_written_prevents_emission(desk, capsys):
    """What the record says stands, and the next play would take the display as cold."""
    command, limits = ["dac", "play", str(desk.frames), *desk.config()], resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        assert run(command) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "a file that can be written; nothing is emitted" in capsys.readouterr().err
    assert not desk.bench.device.light()


def test_a_missing_helios_is_one_line(desk, capsys):
    desk.bench.emulated.unplugged_at_s = 0.0
    assert desk.play() == 2
    assert capsys.readouterr().err == ("optodrive: board: got '1209:e500', expected a connected USB device\n")


def test_a_daemon_on_a_dac_without_an_interlock_is_refused(desk, capsys):
    assert run(["serve", *desk.config("false")]) == 2
    assert "interlock_watched: got false, expected true once an external interlock" in capsys.readouterr().err.lower()


def test_a_daemon_with_early_steps_is_refused(desk, capsys):
    path = desk.config()[1]
    text = Path(path).read_text().replace("[scanner]", '[scanner]\ntrajectories = "early_steps"')
    Path(path).write_text(text)
    assert run(["serve", "--config", path]) == 2
    assert "only `optodrive dac play` sends steps early" in capsys.readouterr().err
