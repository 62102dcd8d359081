"""Several optical stages in a configuration."""

import json

import numpy as np
import pytest

from optodrive.cli.doctor import examine
from optodrive.cli.main import run
from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config, locate_shipped

TWO_STAGES = """
[[stages]]
name = "left"
columns = [0, 1]
board = { transport = "serial", port = "/dev/ttyACM0" }
scanner = { aim_error_m = 1e-5 }

[[stages]]
name = "right"
columns = [1, 3]
board = { transport = "serial", port = "/dev/ttyACM1" }
laser = { max_power_w = 1.5 }
"""


def load(folder, stages, replaced=("", "")):
    text = locate_shipped("display-16.toml").read_text().replace(*replaced)
    (folder / "display.toml").write_text(text + stages)
    return load_config(folder / "display.toml")


def test_a_stage_states_what_differs_from_the_sections(tmp_path):
    config = load(tmp_path, TWO_STAGES)
    left, right = config.list_stage_configs()
    assert (left.board.port, right.board.port) == ("/dev/ttyACM0", "/dev/ttyACM1")
    assert (left.laser, right.laser.max_power_w) == (config.laser, 1.5)
    assert right.laser.pwm_hz == config.laser.pwm_hz
    assert (left.scanner.aim_error_m, right.scanner) == (1e-5, config.scanner)
    assert left.reach.tolist() == [column <= 1 for _ in range(4) for column in range(4)]


NUMBERED = """
[[stages]]
name = "left"
board = { transport = "serial", port = "PORT_A", uid = "UID_A" }
[[stages]]
name = "right"
board = { transport = "serial", port = "PORT_B", uid = "UID_B" }
"""


@pytest.mark.parametrize(
    ("ports", "uids", "named"),
    [
        (("/dev/ttyACM0", "/dev/ttyACM1"), ("", ""), ("'left' on /dev/ttyACM0", "'right' on /dev/ttyACM1")),
        (("/dev/ttyUSB0", "/dev/ttyACM10"), ("", ""), ("'left' on /dev/ttyUSB0", "'right' on /dev/ttyACM10")),
        (("/dev/ttyACM0", "/dev/ttyACM1"), ("0a", ""), ("'right' on /dev/ttyACM1",)),
        (("/dev/ttyACM0", "/dev/serial/by-id/usb-b"), ("", ""), ("'left' on /dev/ttyACM0",)),
        (("/dev/ttyACM0", "/dev/ttyACM1"), ("0a", "0b"), ()),
        (("/dev/serial/by-id/usb-a", "/dev/serial/by-id/usb-b"), ("", ""), ()),
        (("/dev/ttyAMA0", "/dev/ttyAMA1"), ("", ""), ()),  # fixed by the circuit
    ],
)
def test_boards_that_may_change_places_are_named_by_check_and_doctor(tmp_path, capsys, ports, uids, named):
    stages = NUMBERED
    for name, value in zip(("PORT_A", "PORT_B", "UID_A", "UID_B"), (*ports, *uids), strict=True):
        stages = stages.replace(name, value)
    load(tmp_path, stages)
    path = str(tmp_path / "display.toml")
    assert run(["config", "check", "--config", path]) == 0
    said = capsys.readouterr().out
    found = [item for item in examine(path, tmp_path) if item.check == "stages"]
    assert [item.status for item in found] == ["warning"] * bool(named)
    texts = [said, *(item.observation for item in found)]
    assert all(name in text for text in texts for name in named)
    assert ("warning: " in said) == bool(named)
    assert all(f"'{name}' on" not in said for name in ("left", "right") if not any(name in each for each in named))


def test_without_stages_the_sections_are_the_only_one():
    config = load_config("display-16")
    assert config.list_stage_configs() == (config,)
    assert config.reach.all()


def test_a_single_stage_is_the_configuration(tmp_path):
    config = load(tmp_path, '[[stages]]\nname = "only"\nlaser = { max_power_w = 1.5 }\n')
    assert config.laser.max_power_w == 1.5
    assert config.select_stage(None) is config


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        (
            TWO_STAGES.replace('"right"', '"left"'),
            r"stages\[1\].name: got 'left', expected another name than .* stages\[0\]",
        ),
        (
            TWO_STAGES.replace("ttyACM1", "ttyACM0").replace("laser =", "#"),
            r"stages\[1\].board: got serial /dev/ttyACM0, expected another board",
        ),
        (TWO_STAGES.replace("[1, 3]", "[2, 2]"), "stages: got none that reaches pixel 3, expected one"),
        (TWO_STAGES.replace("1e-5", "9e-4"), r"stages\[0\].laser.focus_width_m: got 0.001, expected to fit"),
        (TWO_STAGES.replace("1.5", "-1.5"), r"stages.1.laser.max_power_w: got -1.5"),
        (TWO_STAGES.replace("max_power_w", "max_power"), r"stages.1.laser.max_power: got 'max_power', expected"),
        (TWO_STAGES.replace("1.5", "1500"), r"stages\[1\].laser.max_power_w: got 1500"),
        (TWO_STAGES.replace('name = "left"', ""), r"stages.0.name: missing, expected this key"),
        (TWO_STAGES.replace("[0, 1]", "[1, 0]"), r"stages\[0\].columns: got \[1, 0\], expected .* last of 0 to 3"),
        (TWO_STAGES.replace("[1, 3]", "[0, 99]"), r"stages\[1\].columns: got \[0, 99\]"),
        (TWO_STAGES.replace("[1, 3]", "[-5, 3]"), r"stages\[1\].columns: got \[-5, 3\]"),
        (
            TWO_STAGES + '[sensor]\nport = "/dev/../dev/ttyACM1"\n',
            r"sensor.port: got '/dev/../dev/ttyACM1', expected another",
        ),
        (TWO_STAGES.replace("/dev/ttyACM1", "/dev/./ttyACM0").replace("laser =", "#"), r"stages\[1\].board: got"),
        (
            TWO_STAGES.replace('port = "/dev/ttyACM1"', 'port = "/dev/ttyACM0", baud = 9600'),
            r"stages\[1\].board: got serial /dev/ttyACM0, expected another board",
        ),
    ],
)
def test_what_does_not_fit_is_one_line(tmp_path, stages, message):
    with pytest.raises(InputError, match=message) as refused:
        load(tmp_path, stages)
    assert "\n" not in str(refused.value)


GOES_ON = '[daemon]\non_stage_loss = "that_stage"\n'


def test_the_others_may_go_on_where_two_stages_reach_each_pixel(tmp_path):
    whole = TWO_STAGES.replace("columns", "#")
    assert load(tmp_path, whole).daemon.on_stage_loss == "all_dark"
    assert load(tmp_path, whole + GOES_ON).daemon.on_stage_loss == "that_stage"


@pytest.mark.parametrize(
    ("stages", "expected"),
    [
        (TWO_STAGES, "all_dark while stage 'left' is the only one that reaches pixel 0"),
        (TWO_STAGES.replace("[0, 1]", "[0, 3]"), "all_dark while stage 'left' is the only one that reaches pixel 0"),
        (TWO_STAGES.replace("[1, 3]", "[0, 3]"), "all_dark while stage 'right' is the only one that reaches pixel 2"),
        ('[[stages]]\nname = "only"\n', "all_dark with one stage"),
        ("", "all_dark with one stage"),
    ],
)
def test_a_pixel_that_one_stage_alone_reaches_is_named(tmp_path, stages, expected, capsys):
    with pytest.raises(InputError, match=f"daemon.on_stage_loss: got 'that_stage', expected {expected}"):
        load(tmp_path, stages + GOES_ON)
    assert run(["config", "check", "--config", str(tmp_path / "display.toml")]) == 2
    assert expected in capsys.readouterr().err


def test_stages_are_a_list_of_tables(tmp_path):
    (tmp_path / "display.toml").write_text("stages = 3\n" + locate_shipped("display-16.toml").read_text())
    with pytest.raises(InputError, match="stages: got 3"):
        load_config(tmp_path / "display.toml")


def test_each_stage_has_its_measured_servo_and_the_smallest_cap_holds(tmp_path):
    (tmp_path / "right.toml").write_text(
        'format = "optodrive-mirrors"\nversion = 1\n[scanner]\nbandwidth_hz = 1500.0\ndamping = 0.6\n'
        "delay_s = 1e-4\nslew_rad_per_s = 200.0\n[galvo]\nshare = 0.8\n"
    )
    measured = TWO_STAGES + 'scanner = { mirrors = "right.toml" }\n'
    config, plain = load(tmp_path, measured), load(tmp_path, TWO_STAGES)
    left, right = config.list_stage_configs()
    assert (left.scanner.bandwidth_hz, right.scanner.bandwidth_hz) == (plain.scanner.bandwidth_hz, 1500.0)
    caps = [each.limits.galvo_acceleration_rms_max_rad_per_s2 for each in (config, plain)]
    assert caps[0] == pytest.approx(0.8 * caps[1])


@pytest.mark.parametrize("option", ["--field", "--mirrors"])
def test_a_file_for_one_scanner_is_refused(tmp_path, option, capsys):
    load(tmp_path, TWO_STAGES)
    (tmp_path / "frames.json").write_text("{}")
    arguments = ("plan", tmp_path / "frames.json", "--config", tmp_path / "display.toml", option, "given.toml")
    assert run([str(each) for each in arguments]) == 2
    assert f"{option}: got 'given.toml', expected one stage" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["first-light", "home", "calibrate board"])
@pytest.mark.parametrize(("stage", "found"), [((), "missing"), (("--stage", "top"), "got 'top'")])
def test_commands_that_drive_one_board_want_the_name_of_its_stage(tmp_path, command, stage, found, capsys):
    load(tmp_path, TWO_STAGES)
    own = () if command == "home" else ("--yes",)
    out = ("--out", tmp_path / "field.toml") if command == "calibrate board" else ()
    arguments = (*command.split(), *own, *out, *stage, "--config", tmp_path / "display.toml")
    assert run([str(each) for each in arguments]) == 2
    assert f"--stage: {found}, expected one of left, right" in capsys.readouterr().err


def test_a_stage_is_selected_by_its_name(tmp_path):
    right = load(tmp_path, TWO_STAGES).select_stage("right")
    assert (right.board.port, right.laser.max_power_w, len(right.stages)) == ("/dev/ttyACM1", 1.5, 1)
    with pytest.raises(InputError, match="--stage: got 'left', expected none: the display has one stage"):
        load_config("display-16").select_stage("left")


def test_several_stages_are_simulated(tmp_path, capsys):
    load(tmp_path, TWO_STAGES.replace("laser =", "#"))
    frame = {"show_at_s": 0, "duration_s": 1, "target_um": {str(k): 60 for k in range(16)}}
    (tmp_path / "frames.json").write_text(json.dumps({"frames": [frame]}))
    arguments = ("simulate", tmp_path / "frames.json", "--config", tmp_path / "display.toml", "--json")
    assert run([str(each) for each in arguments]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["executed"] == report["planned"] == 16
    assert report["pixels"][0]["measured_max_um"] == pytest.approx(60.0, rel=0.02)


def test_rows_restrict_the_reach(tmp_path):
    rows = TWO_STAGES.replace("columns = [0, 1]", "rows = [0, 1]").replace("columns = [1, 3]", "rows = [2, 3]")
    lower, upper = load(tmp_path, rows).list_stage_configs()
    assert np.flatnonzero(lower.reach).tolist() == list(range(8))
    assert np.flatnonzero(upper.reach).tolist() == list(range(8, 16))
