"""A whole sweep in virtual time: every pixel at every aim, its journal, its end and its continuation."""

import os

import numpy as np
import pytest

from displays import DISPLAYS
from exclusive_rig import ExclusiveRig
from optodrive.cli.calibrate.pixels import _build_displays
from optodrive.core.errors import BoardFaultError, InputError
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.device.config import Config, build_pixel_layout
from optodrive.device.config_file import load_config
from optodrive.device.field_loader import load_scan_field
from optodrive.lab.calibration.pixel_sweep import (
    PRE_PULSE_S,
    Aim,
    SweepJournal,
    build_aim_map,
    build_runs,
    build_sweep,
    compute_pulse,
    is_reachable,
    list_aims,
)
from optodrive.lab.commissioning import sweep_player
from optodrive.lab.commissioning.sweep_player import plan_aims, play_aims
from optodrive.lab.recording import write_recording
from optodrive.lab.recording.reader import merge_session
from optodrive.link.protocol.quantisation import DUTY_MAX

DISPLAY = DISPLAYS["display-16"]
AIMS = list_aims(DISPLAY.config)


def ignore(item, count):
    pass


@pytest.fixture(name="displays", scope="module")
def build_displays(tmp_path_factory):
    return _build_displays(tmp_path_factory.mktemp("sweep"), "display-16", AIMS)[0]


def open_journal(folder):
    return SweepJournal.open(folder / "pulses.csv", "display-16")


def play(displays, journal, on_progress=ignore):
    """Play the aims that the journal lacks. Return the rig."""
    rig = ExclusiveRig(DISPLAY, lambda x_code, y_code, at_us: None)
    plans = plan_aims(displays, journal)
    with rig.armed() as board:
        try:
            play_aims(plans, board, journal, 1.0, on_progress)
        finally:
            journal.close()
    return rig


def test_every_pixel_is_pulsed_at_every_aim_under_one_arming(displays, tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_player, "PULSES_PER_JOB", 5)  # jobs of several sizes
    rig = play(displays, open_journal(tmp_path))
    assert rig.core.state == "DISARMED"
    assert [event["state"] for event in rig.of("state")].count("ARMED") >= 1
    assert [event["state"] for event in rig.of("state")].count("ARMING") == 1
    logged, written = rig.of("pulse"), open_journal(tmp_path)
    assert len(logged) == len(written.pulses) == 16 * len(AIMS)
    layout, config = build_pixel_layout(DISPLAY.config.display), DISPLAY.config
    offsets, scale = {aim.name: aim for aim in AIMS}, rig.held.session.scale
    for event, pulse in zip(logged, written.pulses, strict=True):
        aim = offsets[pulse.aim]
        width_s, power_w = compute_pulse(config, aim)
        x_rad, y_rad = scale.to_angles_rad(np.array([event["x"], event["y"]]))
        code_m = 2.0 * config.scanner.focal_length_m * config.scanner.rad_per_code
        assert 2.0 * config.scanner.focal_length_m * x_rad == pytest.approx(
            layout.x_m[pulse.pixel] + aim.x_m, abs=code_m
        )
        assert 2.0 * config.scanner.focal_length_m * y_rad == pytest.approx(
            layout.y_m[pulse.pixel] + aim.y_m, abs=code_m
        )
        assert (event["off_us"] - event["on_us"]) * 1e-6 == pytest.approx(pulse.width_s) == pytest.approx(width_s)
        duty_w = event["duty"] / DUTY_MAX * config.laser.max_power_w
        assert duty_w == pytest.approx(pulse.power_w, abs=1e-8)
        assert power_w - 1e-4 < duty_w <= power_w
    written.close()
    runs = build_runs(written.pulses, AIMS, "display-16", 295.0).runs
    assert len({run.name for run in runs}) == 16 * len(AIMS)
    assert {(run.attributes["aim_x_m"], run.attributes["aim_y_m"]) for run in runs} == {aim[1:] for aim in AIMS}
    assert all(run.pulses[0, 0] == PRE_PULSE_S for run in runs)
    check_merge(tmp_path, runs)


def check_merge(folder, runs):
    """Merge the runs with a signal of one of them, as an instrument would have measured it."""
    write_recording(folder / "recording", Measurement(runs))
    signal = Signal(3, np.linspace(0.0, 0.1, 20), np.linspace(0.0, 1e-5, 20))
    write_recording(
        folder / "measured", Measurement((Run("x-plus-1-0003", 295.0, np.zeros((0, 4)), {"displacement_m": signal}),))
    )
    (merged,) = merge_session(folder / "recording", folder / "measured").runs
    assert merged.pulses[0, 3] == 3.0
    assert merged.attributes["aim_x_m"] > 0.0


def test_a_fault_leaves_all_pulses_before_it_and_the_rest_is_played_later(displays, tmp_path):
    journal = open_journal(tmp_path)
    rigs = []

    def open_interlock(item, count):
        if len(journal.pulses) >= 40:
            rigs[0].core.set_input("interlock", False, round(rigs[0].clock.now_s() * 1e6))

    rig = ExclusiveRig(DISPLAY, lambda x_code, y_code, at_us: None)
    rigs.append(rig)
    plans = plan_aims(displays, journal)
    with rig.armed() as board, pytest.raises(BoardFaultError, match="FAULT INTERLOCK"):
        play_aims(plans, board, journal, 1.0, open_interlock)
    journal.close()
    assert not rig.core.gate
    again = open_journal(tmp_path)
    done = {pulse[:2] for pulse in again.pulses}
    assert len(rig.of("pulse")) == len(done) == len(again.pulses) >= 40
    rest = play(displays, again)
    complete = open_journal(tmp_path)
    complete.close()
    assert len(rest.of("pulse")) == 16 * len(AIMS) - len(done)
    assert len({pulse[:2] for pulse in complete.pulses}) == len(complete.pulses) == 16 * len(AIMS)


def test_a_line_without_its_end_is_dropped(displays, tmp_path):
    journal = open_journal(tmp_path)
    journal.close()
    path = journal.path
    path.write_text(path.read_text() + "middle,3,1.0,2.0,0.005,2.45\nmiddle,4,1.0,2.")
    again = open_journal(tmp_path)
    again.close()
    assert [pulse.pixel for pulse in again.pulses] == [3]
    assert path.read_text().endswith("2.45\n")
    assert again.list_done("middle") == {3}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("# optodrive sweep of display-437\n", "expected '# optodrive sweep of display-16'"),
        ("t_s,value\n1,2\n", "got 't_s,value'"),
    ],
)
def test_another_journal_is_refused(tmp_path, text, says):
    (tmp_path / "pulses.csv").write_text(text)
    with pytest.raises(InputError, match=r"pulses\.csv") as caught:
        open_journal(tmp_path)
    assert says in str(caught.value)


def test_a_full_disk_ends_the_sweep_dark(displays, tmp_path, monkeypatch):
    journal = open_journal(tmp_path)

    def fail(file, data):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("optodrive.lab.calibration.pixel_sweep.os.write", fail)

    def play_to_the_end():
        play(displays, journal)
        journal.raise_if_failed()  # the sweep may be faster than the first write

    with pytest.raises(InputError, match="No space left"):
        play_to_the_end()


def test_a_pixel_gets_no_pulse_at_an_aim_beyond_the_mirrors_range(displays, tmp_path):
    """As on display-1511, whose outermost pixels are 0.8 mm from the end of the range."""
    aim, display = displays[1]
    layout = build_pixel_layout(display.config.display)
    range_rad = (np.abs(layout.x_m).max() + 0.0005) / (2.0 * display.config.scanner.focal_length_m)
    scanner = display.config.scanner.model_copy(update={"range_rad": range_rad})
    narrow = display.__class__.from_config(display.config.model_copy(update={"scanner": scanner}))
    journal = open_journal(tmp_path)
    (item,) = plan_aims([(aim, narrow)], journal)
    journal.close()
    assert aim.name == "x-minus-1"
    assert sorted(item.plan.pixel) == np.flatnonzero(layout.x_m > layout.x_m.min()).tolist()
    assert np.abs(item.plan.x_rad).max() <= range_rad


def test_the_files_of_a_sweep_move_only_the_pixels_that_they_pulse():
    config = load_config("display-1511")
    layout = build_pixel_layout(config.display)
    aim = Aim("x-plus-2", 0.0012, 0.0)
    reached = is_reachable(config, load_scan_field(config), aim)
    assert 0 < np.count_nonzero(~reached) < 50
    assert np.all(layout.x_m[~reached] == layout.x_m.max())
    assert np.array_equal(build_aim_map(aim, reached).offset_x_m, np.where(reached, 0.0012, 0.0))
    assert {train.pixel for train in build_sweep(config, aim, reached)} == set(np.flatnonzero(reached).tolist())


def use_laser(**keys):
    """Return the configuration of a small display with another laser."""
    table = load_config("display-16").model_dump()
    return Config.model_validate(table | {"laser": table["laser"] | keys})


def test_pulses_of_a_laser_that_is_on_or_off_are_short_instead_of_weak():
    config = use_laser(modulation="on_off")
    aims = list_aims(config)
    for aim in aims:
        width_s, power_w = compute_pulse(config, aim)
        assert power_w == config.laser.max_power_w
        assert width_s * 1e6 == pytest.approx(round(width_s * 1e6))
        # A wall takes no more than the surface of a half-space does at the same rise: power times the root of time.
        weak_s, weak_w = compute_pulse(load_config("display-16"), aim)
        if aim.name != "middle":
            assert width_s < weak_s
            assert power_w * width_s**0.5 <= weak_w * weak_s**0.5 * 1.5
    with pytest.raises(InputError, match=r"laser\.threshold_w: got 0\.4, expected at most 0\.188 W across the edge"):
        compute_pulse(use_laser(threshold_w=0.4), aims[1])
