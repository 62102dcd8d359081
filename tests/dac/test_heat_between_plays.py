"""Plays of several users on one Helios, judged by an integrator of the display: no surface passes its cap.

Each play is a process with a user, a HOME and a device name of its own, in virtual time. Between plays records are
lost, damaged, taken away and brought back, plays are killed, and the computer restarts.
"""

import json
import os
import pickle
import shutil
import socket
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import usb.backend.libusb1
from hypothesis import given, settings
from hypothesis import strategies as st

from dac.bench import Bench, build_display, build_train, record_cold
from dac.device_process import DeviceProcess, serve_ether_dream
from dac.emulated_helios import CLOCK_HZ, EmulatedHelios
from dac.judge import read_light
from optodrive.cli.invocation import DOES_NOT_FIT
from optodrive.cli.main import run
from optodrive.device.config_file import locate_shipped
from optodrive.link.dac.devices.ether_dream import EtherDream
from optodrive.link.dac.devices.helios import Helios
from optodrive.link.dac.formats.ether_dream import BROADCAST_PORT
from optodrive.link.dac.laser_dac import build_uid
from optodrive.planning import heat_record
from optodrive.planning.stimuli.sequence_file import sequence_to_json
from reference_models.shipped_display import build_model, build_worst_factors
from reference_models.thermal_display import TOUCHED, build_true_display

USERS = (0, 1001, 1002)
RECORD = f"helios-{build_uid('any')}"
LONG = build_train(width_s=0.04, gap_s=0.002, power_w=2.45, duration_s=4.0)
AFTER_DEATH_S, BETWEEN_S = 1.0, 0.3
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="processes of several users need root")


class MortalHelios(EmulatedHelios):
    """The emulated DAC. A killed host ends at once: nothing of its program runs any more."""

    on_death = None

    def _now(self):
        if self.clock.now_s() >= self.dies_at_s:
            self.pass_time(AFTER_DEATH_S)
            self.on_death()
        super()._now()


class Room:
    """A computer with one Helios and its display: the light of all plays, in true time."""

    def __init__(self):
        self.folder = Path(tempfile.mkdtemp(prefix="heat"))
        self.folder.chmod(0o755)
        self.now_s, self.boot, self.booted_s, self.name = 1000.0, 1, 0.0, "Helios 1"
        self.backup, self.light = None, []
        self.display = build_display()
        self.records = self.folder / "heat"
        self.frames = self.folder / "frames.json"
        self.frames.write_text(json.dumps(sequence_to_json(LONG)))
        text = locate_shipped("display-16.toml").read_text()
        text = text.replace('transport = "simulated"', 'transport = "helios"\ninterlock_watched = true')
        self.config = self.folder / "helios.toml"
        self.config.write_text(text.replace("[scanner]", "[scanner]\nhalf_range_codes = 2047"))
        self.kept = heat_record.FOLDER, heat_record.read_boot
        heat_record.FOLDER, heat_record.read_boot = (
            self.records,
            lambda: (f"run {self.boot}", self.now_s - self.booted_s),
        )

    def __enter__(self):
        record_cold(self.display, "helios", "any")
        return self

    def __exit__(self, *details):
        heat_record.FOLDER, heat_record.read_boot = self.kept
        shutil.rmtree(self.folder)

    def play(self, user=0, ends="complete", after_s=1.0):
        """Play in a process of a user. ends: complete, killed or interrupted, after_s from the begin."""
        reading, writing = os.pipe()
        pid = os.fork()
        if not pid:
            try:
                self._play_and_exit(user, ends, after_s, writing)
            finally:
                os._exit(99)
        os.close(writing)
        with os.fdopen(reading, "rb") as pipe:
            answer = pickle.loads(pipe.read())
        os.waitpid(pid, 0)
        table, passed_s, status = answer
        if (table[:, 5] > 0).any():
            light = read_light(table, self.display, 1.0)
            self.light.append((light.start_s + self.now_s, light.width_s, light.power_w, light.pixel))
        self.now_s += passed_s + BETWEEN_S
        return status, float(light.power_w @ light.width_s) if (table[:, 5] > 0).any() else 0.0

    def _play_and_exit(self, user, ends, after_s, writing):
        bench = Bench(name=self.name)
        emulated = MortalHelios(bench.clock, name=self.name)

        def answer(status, passed_s):
            log = emulated.device.log
            ends_s = [*(output.at_s for output in log[1:]), emulated.device.now / CLOCK_HZ]
            rows = [
                (output.at_s, end_s, number, output.x, output.y, max(output.colour) / 255)
                for number, (output, end_s) in enumerate(zip(log, ends_s, strict=True))
            ]
            with os.fdopen(writing, "wb") as pipe:
                pickle.dump((np.array(rows), passed_s, status), pipe)
            os._exit(0)

        began_s = self.now_s
        heat_record.read_boot = lambda: (f"run {self.boot}", began_s + bench.clock.now_s() - self.booted_s)
        usb.backend.libusb1.get_backend = lambda: emulated
        import optodrive.core.clock

        optodrive.core.clock.MonotonicClock = lambda: bench.clock
        emulated.on_death = lambda: answer(137, bench.clock.now_s() - AFTER_DEATH_S)
        if ends == "killed":
            emulated.dies_at_s = after_s
        write, sent = emulated.bulk_write, []

        def write_until(*transfer):
            sent.append(transfer)
            if ends == "interrupted" and bench.clock.now_s() > after_s:
                os.kill(os.getpid(), 2)
            return write(*transfer)

        emulated.bulk_write = write_until
        os.environ |= {"HOME": str(self.folder / str(user)), "XDG_STATE_HOME": f"state-{user}"}
        for descriptor in (1, 2):
            os.dup2(os.open("/dev/null", os.O_WRONLY), descriptor)
        os.chdir(self.folder)
        os.setgroups([])
        os.setgid(user)
        os.setuid(user)
        status = run(["dac", "play", str(self.frames), "--config", str(self.config)])
        emulated.pass_time(0.2)
        answer(status, bench.clock.now_s())

    def do(self, fault, user=0):
        """Do something to the record, the device or the computer."""
        record = self.records / RECORD
        if fault == "restart":
            self.boot, self.booted_s = self.boot + 1, self.now_s
            self.now_s += 20.0
        elif fault == "rename":
            self.name = "Helios 2" if self.name == "Helios 1" else "Helios 1"
        elif fault == "lose all":
            shutil.rmtree(self.records, ignore_errors=True)
        elif fault == "close folder" and self.records.exists():
            self.records.chmod(0o755)
        elif fault == "back up" and record.exists():
            self.backup = record.read_bytes()
        elif fault == "restore" and self.backup is not None and self.records.exists():
            mtime_ns = record.stat().st_mtime_ns if record.exists() else 0
            record.write_bytes(self.backup)
            record.chmod(0o666)
            os.utime(record, ns=(mtime_ns, mtime_ns))
        elif record.exists():
            data = record.read_bytes()
            if fault == "lose":
                record.unlink()
            elif fault == "cut":
                record.write_bytes(data[: len(data) // 2])
            elif fault == "version":
                record.write_bytes(data.replace(heat_record.MAGIC, b"optodrive-heat 5\n"))
            elif fault == "seize":
                os.chown(record, user, user)
                record.chmod(0o600)
            elif fault == "release":
                record.chmod(0o666)

    def judge(self):
        """Return by how much the hottest touched surface of the worst display has passed its cap, K."""
        start_s, width_s, power_w, pixel = (np.concatenate(column) for column in zip(*self.light, strict=True))
        light = SimpleNamespace(start_s=start_s - start_s[0], width_s=width_s, power_w=power_w, pixel=pixel)
        true_display = build_true_display(build_model("display-16"), build_worst_factors("display-16", -1))
        return float(true_display.peaks(light)[list(TOUCHED)].max() - self.display.budget.caps.touch_k)


@pytest.fixture(scope="module", autouse=True)
def _loaded():
    """Import what a play imports late: a user who is not root may not read it."""
    bench = Bench()
    with Room() as room, pytest.MonkeyPatch.context() as patch:
        patch.setattr(usb.backend.libusb1, "get_backend", lambda: bench.emulated)
        patch.setattr("optodrive.core.clock.MonotonicClock", lambda: bench.clock)
        for _ in range(2):
            assert run(["dac", "play", str(room.frames), "--config", str(room.config)]) == DOES_NOT_FIT
            room.do("lose")


FAULTS = (
    "restart",
    "rename",
    "lose",
    "lose all",
    "close folder",
    "back up",
    "restore",
    "cut",
    "version",
    "seize",
    "release",
)
ENDS = ("complete", "complete", "killed", "interrupted")
STEPS = st.one_of(
    st.tuples(st.just("play"), st.sampled_from(USERS), st.sampled_from(ENDS), st.floats(0.3, 4.0)),
    st.tuples(st.just("do"), st.sampled_from(FAULTS), st.sampled_from(USERS)),
    st.tuples(st.just("wait"), st.sampled_from([0.5, 5.0, 40.0])),
)  # fmt: skip


def check_sequence(steps):
    with Room() as room:
        room.play()
        for kind, *values in steps:
            if kind == "wait":
                room.now_s += values[0]
            else:
                getattr(room, kind)(*values)
        room.play(user=1001)
        assert room.judge() <= 0.0


@needs_root
@settings(max_examples=6, deadline=None)
@given(st.lists(STEPS, min_size=1, max_size=6))
def test_no_surface_passes_its_cap(steps):
    check_sequence(steps)


@needs_root
@pytest.mark.slow
@pytest.mark.timeout(0)
@settings(max_examples=400, deadline=None)
@given(st.lists(STEPS, min_size=3, max_size=12))
def test_no_surface_passes_its_cap_in_long_sequences(steps):
    check_sequence(steps)


SCRIPTS = {
    "another user": [("play", 1001)],
    "another name": [("do", "rename"), ("play", 1001)],
    "lost": [("do", "lose"), ("play", 1001)],
    "killed": [("play", 0, "killed", 3.0), ("play", 1001)],
    "interrupted": [("play", 0, "interrupted", 3.0), ("play", 1001)],
    "seized and released": [
        ("do", "back up"), ("do", "seize", 1002), ("play", 1001), ("do", "release"), ("play", 1002)
    ],
    "restored": [("do", "restore"), ("play", 1001)],
    "restarted": [("do", "restart"), ("play", 1001)],
}  # fmt: skip


def run_script(steps):
    with Room() as room:
        room.do("back up")
        room.play()
        for kind, *values in steps:
            getattr(room, kind)(*values)
        return room.judge()


@needs_root
@pytest.mark.parametrize("script", SCRIPTS)
def test_what_may_have_warmed_the_display_counts(script):
    assert run_script(SCRIPTS[script]) <= 0.0


def _keep_per_user(patch):
    """Let each user have a folder of records, and take a display without one as cold."""
    enter = heat_record.HeatRecord.__enter__

    def enter_own(record):
        heat_record.FOLDER = Path(f"{heat_record.FOLDER}-{os.getuid()}")
        return enter(record)

    patch.setattr(heat_record.HeatRecord, "__enter__", enter_own)
    patch.setattr(heat_record, "build_hot_budget_state", lambda cold, budget: cold)


MUTANTS = {
    "another user": _keep_per_user,
    "another name": lambda patch: patch.setattr(Helios, "find_identity", lambda helios: helios.name),
    "lost": lambda patch: patch.setattr(heat_record, "build_hot_budget_state", lambda cold, budget: cold),
    "killed": lambda patch: patch.setattr(heat_record.HeatRecord, "begin_use", lambda record: None),
    "restored": lambda patch: patch.setattr(heat_record.HeatRecord, "_judge", lambda record, file: None),
}


@needs_root
@pytest.mark.parametrize("script", MUTANTS)
def test_a_program_that_forgets_is_caught(script, monkeypatch):
    """Mutants: the record is a user's or a name's, a lost one is cold, a killed play left none, an old copy counts."""
    MUTANTS[script](monkeypatch)
    if script == "another name":
        monkeypatch.setattr(heat_record, "build_hot_budget_state", lambda cold, budget: cold)
    assert run_script(SCRIPTS[script]) > 0.0


MAC = "00:04:a3:01:02:03"


class EtherDreamDesk:
    """An emulated Ether Dream on loopback, and how it is addressed."""

    def __init__(self, folder, capsys):
        self.folder, self.capsys = folder, capsys
        self.device = DeviceProcess(serve_ether_dream, folder, BROADCAST_PORT)
        self.spellings = [
            self.device.address,
            f"{self.device.address}:7765",
            f"::ffff:{self.device.address}",
            f"[::ffff:{self.device.address}]:7765",
            hex(int.from_bytes(socket.inet_aton(self.device.address))),
        ]

    def ask(self, spelling, uid="", status=0):
        """Return what `info` says, or its error."""
        text = locate_shipped("display-16.toml").read_text()
        lines = f'transport = "ether_dream"\nport = "{spelling}"\nuid = "{uid}"'
        path = self.folder / "dac.toml"
        text = text.replace('transport = "simulated"', lines)
        path.write_text(text.replace("[scanner]", "[scanner]\nhalf_range_codes = 2047"))
        assert run(["dac", "info", "--config", str(path), "--json"]) == status
        said = self.capsys.readouterr()
        return said.err if status else json.loads(said.out)

    def is_recorded(self, spelling):
        return self.ask(spelling)["heat"] == "recorded"


@pytest.fixture
def desk(tmp_path, capsys):
    desk = EtherDreamDesk(tmp_path, capsys)
    record_cold(build_display(), "ether_dream", MAC)
    yield desk
    desk.device.finish()


def test_every_spelling_of_an_address_is_one_display(desk, monkeypatch):
    for number, spelling in enumerate(desk.spellings):
        monkeypatch.setenv("HOME", str(desk.folder / str(number)))
        monkeypatch.setenv("XDG_STATE_HOME", "relative")
        assert desk.is_recorded(spelling)
    assert [path.name for path in heat_record.FOLDER.iterdir()] == [f"ether_dream-{build_uid(MAC)}"]


def test_records_of_spellings_are_caught(desk, monkeypatch):
    """Mutant: the record belongs to the configured address."""
    monkeypatch.setattr(EtherDream, "find_identity", lambda dac: dac.board.port)
    assert not any(map(desk.is_recorded, desk.spellings))


def test_an_ether_dream_that_is_not_heard_is_hot_and_ends_all_records_of_its_kind(desk):
    silent = DeviceProcess(serve_ether_dream, desk.folder)  # a firewall
    assert "the device does not say which one it is" in desk.ask(silent.address)["heat"]
    silent.finish()
    assert "this machine had no record of its heat" in desk.ask(desk.device.address)["heat"]


def test_the_hardware_address_of_an_ether_dream_is_its_uid(desk):
    assert desk.ask(desk.device.address, MAC)["name"] == MAC
    error = desk.ask(desk.device.address, "00:04:a3:ff:ff:ff", status=2)
    assert "board.uid: got '00:04:a3:ff:ff:ff', expected the Ether Dream of this hardware address; the one" in error
    assert f"has '{MAC}'" in error
    silent = DeviceProcess(serve_ether_dream, desk.folder)
    assert "tells none, for it is not heard on UDP 7654" in desk.ask(silent.address, MAC, status=2)
    silent.finish()
