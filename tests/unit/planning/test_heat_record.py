"""Record of a display's heat: what counts, what makes a display hot, and that a hot one is a bound."""

import os
import re
import shutil
import subprocess
import time
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from dac.bench import build_config, build_display, build_train
from optodrive.core.clock import ManualClock
from optodrive.core.errors import InputError
from optodrive.core.types.plans import BudgetState
from optodrive.link.simulator.guards import BoardSettings
from optodrive.planning import heat_record
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.heat_record import BOARDS, LIGHTLESS, HeatRecord, build_hot_budget_state, join_uids
from optodrive.planning.limiter.limiter import shift_state
from optodrive.planning.pipeline import plan_sequence

UP_S = 1e5
SEQUENCE = build_train(width_s=0.04, gap_s=0.004, duration_s=1.0, power_w=2.0)
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="files of other users need root")


class Desk:
    """A machine's folder of records, its uptime, and the state after a play."""

    def __init__(self, folder):
        self.display = build_display()
        self.budget = plan_sequence(self.display, SEQUENCE, *self.display.build_cold_state()).budget
        self.folder, self.path = folder, folder / "helios-any"
        self.boot, self.up_s = "a run", UP_S

    def open(self, identity="any", display=None):
        return HeatRecord("helios", identity, display or self.display, ManualClock())

    def save(self):
        with self.open() as record:
            record.load()
            record.begin_use()
            record.save(self.budget, self.budget.at_s)

    def load(self, **options):
        with self.open(**options) as record:
            return record.load(), record.hot_reason

    def is_hot(self, state):
        return state.panel_k.max() == pytest.approx(build_hot_budget_state(state, self.display.budget).panel_k.max())


@pytest.fixture
def desk(tmp_path, monkeypatch):
    monkeypatch.setattr(heat_record, "FOLDER", tmp_path / "heat")
    desk = Desk(tmp_path / "heat")
    monkeypatch.setattr(heat_record, "read_boot", lambda: (desk.boot, desk.up_s))
    return desk


def assert_shifted(back, before, offset_s):
    expected = shift_state(before, offset_s)
    for item in fields(BudgetState):
        assert np.asarray(getattr(back, item.name)) == pytest.approx(np.asarray(getattr(expected, item.name)), abs=1e-6)


@pytest.mark.parametrize(("boot", "up_s", "passed_s"), [("a run", UP_S + 100.0, 100.0), ("the next", 30.0, 30.0)])
def test_a_display_cools_by_the_uptime(desk, boot, up_s, passed_s):
    """How long a computer was off is what a clock says that may have been set: that time does not count."""
    desk.save()
    desk.boot, desk.up_s = boot, up_s
    state, reason = desk.load()
    assert not reason
    assert_shifted(state, desk.budget, -desk.budget.at_s - passed_s)


def test_the_folder_and_its_files_belong_to_all(desk):
    before = os.umask(0o077)
    try:
        desk.save()
    finally:
        os.umask(before)
    assert (desk.folder.stat().st_mode & 0o7777, desk.path.stat().st_mode & 0o777) == (0o1777, 0o666)


def test_without_a_record_a_display_is_hot_and_cools_from_then_on(desk):
    state, reason = desk.load()
    assert (reason, desk.is_hot(state)) == ("this machine had no record of its heat", True)
    desk.up_s += 2000.0
    later, reason = desk.load()
    assert not reason
    assert_shifted(later, state, -2000.0)
    planned = plan_sequence(desk.display, SEQUENCE, desk.display.build_cold_heat(), later)
    cold = plan_sequence(desk.display, SEQUENCE, *desk.display.build_cold_state())
    assert planned.plan.energy_j.sum() == pytest.approx(cold.plan.energy_j.sum())


def damage(kind):
    def do(desk):
        data = desk.path.read_bytes()
        if kind == "cut":
            data = data[:-10]
        elif kind == "flipped":
            data = data[:-400] + bytes([data[-400] ^ 1]) + data[-399:]
        elif kind == "version":
            data = b"optodrive-heat 5\n" + data[17:]
        elif kind == "empty":
            data = b""
        desk.path.write_bytes(data)

    return do


def await_tick(path):
    """Wait until the file system's clock, which has ticks of milliseconds, is past the last change of a file."""
    other = path.parent.parent / "tick"
    other.touch()
    while other.stat().st_ctime_ns <= path.stat().st_ctime_ns:
        time.sleep(0.001)
        other.touch()


def restore_a_copy(desk):
    await_tick(desk.path)
    shutil.copy2(desk.path, desk.folder.parent / "copy")
    desk.path.unlink()
    shutil.copy2(desk.folder.parent / "copy", desk.path)


def change_mode_and_back(desk):
    await_tick(desk.path)
    desk.path.chmod(0o600)
    desk.path.chmod(0o666)


def link_elsewhere(desk):
    desk.path.rename(desk.folder.parent / "elsewhere")
    desk.path.symlink_to(desk.folder.parent / "elsewhere")


def link_folder_elsewhere(desk):
    desk.folder.rename(desk.folder.parent / "elsewhere")
    desk.folder.symlink_to(desk.folder.parent / "elsewhere")


def make_folder(desk):
    desk.path.unlink()
    desk.path.mkdir()


FAULTS = {
    "cut": (damage("cut"), "damaged"),
    "flipped": (damage("flipped"), "damaged"),
    "version": (damage("version"), "another version"),
    "empty": (damage("empty"), "no record"),
    "lost": (lambda desk: desk.path.unlink(), "no record"),
    "all lost": (lambda desk: shutil.rmtree(desk.folder), "no record"),
    "another user's": (lambda desk: desk.path.chmod(0o600), "not every user"),
    "changed": (change_mode_and_back, "changed after"),
    "a copy": (restore_a_copy, "changed after"),
    "a link": (link_elsewhere, "no record"),
    "linked twice": (lambda desk: os.link(desk.path, desk.folder.parent / "second"), "no record"),
    "a folder": (make_folder, "another user's"),
    "a closed folder": (lambda desk: desk.folder.chmod(0o755), "no record"),
    "a linked folder": (link_folder_elsewhere, "Not a directory"),
    "restored from the future": (lambda desk: setattr(desk, "up_s", 5.0), "time to come"),
    "a hidden run": (lambda desk: setattr(desk, "boot", ""), "hides"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_others_may_have_missed_makes_a_display_hot(desk, fault):
    desk.save()
    change, words = FAULTS[fault]
    change(desk)
    state, reason = desk.load()
    assert words in reason
    assert "\n" not in reason
    assert desk.is_hot(state)


def test_a_link_is_never_written_through(desk):
    desk.save()
    victim = desk.folder.parent / "victim"
    victim.write_text("of another program")
    for make in (desk.path.symlink_to, desk.path.hardlink_to):
        desk.path.unlink()
        make(victim)
        desk.save()
        assert victim.read_text() == "of another program"


def test_a_process_that_died_in_use_leaves_a_hot_display(desk):
    desk.save()
    with desk.open() as record:
        record.load()
        record.begin_use()
    state, reason = desk.load()
    assert (reason, desk.is_hot(state)) == ("the process that used it last was killed", True)


def test_damaged_numbers_are_hot(desk):
    """NaN passes every comparison of the limiter: a third more light was planned than the caps allow."""
    for name in (item.name for item in fields(BudgetState)):
        for value in (np.full_like(getattr(desk.budget, name), np.nan, dtype=float), np.zeros((3, 3, 3)), "text"):
            with desk.open() as record:
                record.save(desk.budget.__class__(**(vars(desk.budget) | {name: np.asarray(value)})))
            state, reason = desk.load()
            assert "damaged" in reason, name
            assert desk.is_hot(state)


def test_another_display_on_the_device_is_hot(desk):
    desk.save()
    other = DisplayModel.from_config(build_config("display-16", points_per_s=20_000))
    assert not desk.load(display=other)[1]  # the rate of points is no matter of heat
    table = build_config("display-16").model_dump()
    table["display"]["pitch_m"] *= 1.1
    other = DisplayModel.from_config(other.config.model_validate(table))
    assert "another configuration" in desk.load(display=other)[1]
    assert "another configuration" in desk.load()[1]


def test_a_device_that_does_not_say_which_it_is_may_be_each_of_its_kind(desk):
    desk.save()
    with HeatRecord("idn", "07", desk.display, ManualClock()) as record:
        record.save(desk.budget)
    state, reason = desk.load(identity=None)
    assert (reason, desk.is_hot(state)) == ("the device does not say which one it is", True)
    assert "no record" in desk.load()[1]
    with HeatRecord("idn", "07", desk.display, ManualClock()) as record:
        record.load()
        assert not record.hot_reason


def test_one_process_at_a_time(desk):
    desk.save()
    waits = []
    with desk.open() as first:
        first.load()
        second = HeatRecord("helios", "any", desk.display, ManualClock(), lambda: waits.append(1))
        with pytest.raises(InputError, match="in use"), second:
            pass
    assert len(waits) > 10
    assert not desk.load()[1]


@needs_root
def test_a_record_that_only_this_process_cannot_write_prevents_emission(desk):
    """Others may trust it, and would take the display as cold."""
    desk.save()
    if subprocess.run(["chattr", "+i", desk.path], capture_output=True).returncode:
        pytest.skip("this file system has no immutable files")
    try:
        with (
            pytest.raises(InputError, match="permission to record the display's heat; nothing is emitted"),
            desk.open(),
        ):
            pass
    finally:
        subprocess.run(["chattr", "-i", desk.path], check=True)


def test_a_hot_display_is_warmer_than_any_play_leaves_one(desk):
    display = desk.display
    state = display.build_cold_state()[1]
    hot = build_hot_budget_state(state, display.budget)
    rng = np.random.default_rng(4)
    for _ in range(25):
        pixel, width_s = int(rng.integers(16)), float(rng.choice([2e-3, 0.02, 0.05]))
        sequence = build_train(width_s=width_s, gap_s=6e-4, duration_s=2.0, power_w=2.45, pixel=pixel)
        state = plan_sequence(display, sequence, display.build_cold_heat(), shift_state(state, -state.at_s)).budget
        for name in ("rise_k", "wall_k", "touch_k", "panel_k", "bucket_j", "inflow_w", "merged_width_s"):
            assert (getattr(state, name) <= getattr(hot, name) * (1 + 1e-9)).all(), name


BOARD_A, BOARD_B, BOARD_C = ("0a" * 12, "0b" * 12, "0c" * 12)


def use_boards(desk, uids, is_part=False):
    """Use a display of boards. Return why it counted as hot."""
    with HeatRecord(BOARDS, join_uids(uids, is_part), desk.display, ManualClock()) as record:
        record.load()
        record.begin_use()
        record.save(desk.budget)
    return record.hot_reason


def test_a_use_of_a_board_ends_all_other_records_that_name_it(desk):
    for uids in ((BOARD_A, BOARD_B), (BOARD_C,)):
        assert "no record" in use_boards(desk, uids)
    assert not use_boards(desk, (BOARD_B, BOARD_A))
    assert "no record" in use_boards(desk, (BOARD_A,))
    assert "no record" in use_boards(desk, (BOARD_A, BOARD_B))
    assert "no record" in use_boards(desk, (BOARD_B, BOARD_C))
    assert "no record" in use_boards(desk, (BOARD_C,))


def test_a_board_that_draws_a_part_is_always_hot_and_ends_the_record_of_the_whole(desk):
    use_boards(desk, (BOARD_A, BOARD_B))
    for _ in range(3):
        for board in (BOARD_A, BOARD_B):
            assert use_boards(desk, (board,), is_part=True)
    assert "no record" in use_boards(desk, (BOARD_A, BOARD_B))


def test_one_process_at_a_time_uses_a_board(desk):
    with HeatRecord(BOARDS, join_uids((BOARD_A, BOARD_B)), desk.display, ManualClock()) as record:
        record.load()
        for uids, is_part in (((BOARD_A,), True), ((BOARD_B,), False), ((BOARD_B, BOARD_C), False)):
            with pytest.raises(InputError, match=r"-.*got 'in use', expected no other process"):
                use_boards(desk, uids, is_part)


def test_a_board_that_is_a_program_is_cold_and_leaves_no_record(desk):
    """Simulated boards, and the protocol's core as a process: their uids are in both places."""
    core = Path("firmware_protocol/ports/host/settings.c").read_text()
    host = re.search(r'memcpy\(config->uid, "([^"]{12})"', core)[1].encode().hex()
    assert {BoardSettings().uid, host} == LIGHTLESS
    for uids in ((BoardSettings().uid,), (host, BoardSettings().uid)):
        with HeatRecord(BOARDS, join_uids(uids), desk.display, ManualClock()) as record:
            record.begin_use()
            assert record.load().panel_k.max() == 0.0
            record.save(desk.budget)
    assert not desk.folder.exists()
    assert "no record" in use_boards(desk, (BoardSettings().uid, BOARD_A))


def test_a_hot_display_says_why_until_it_has_cooled(desk):
    reason = "this machine had no record of its heat"
    with desk.open() as record:
        record.load()
        why, cooling_s = record.read_cooling()
        assert (why, record.describe()) == (reason, f"hot, because {reason}; it cools within {cooling_s:.0f} s")
        record.begin_use()
        desk.up_s += 100.0
        record.save(desk.budget)
    for boot, up_s, passed_s in (("a run", UP_S + 300.0, 300.0), ("the next", 50.0, 150.0)):
        desk.boot, desk.up_s = boot, up_s
        with desk.open() as record:
            record.load()
            assert record.read_cooling() == (reason, pytest.approx(cooling_s - passed_s))
            assert record.describe().startswith(f"still warm, because {reason}; ")
    desk.up_s += cooling_s
    with desk.open() as record:
        record.load()
        assert (record.describe(), record.read_cooling()) == ("recorded", ("", 0.0))


def test_a_record_knows_its_owner(desk):
    for owner, other, expected in (("me", "me", True), ("me", "you", False), ("", "", False)):
        with HeatRecord("helios", "any", desk.display, ManualClock(), owner=owner) as record:
            record.load()
            record.begin_use()
        with HeatRecord("helios", "any", desk.display, ManualClock(), owner=other) as record:
            assert record.resume() is expected
            record.load()
            assert record.hot_reason == "the process that used it last was killed"
