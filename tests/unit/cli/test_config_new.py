"""`optodrive config new` writes a file that is valid for the display asked for, and overwrites nothing."""

import os
import subprocess
import sys

import numpy as np
import pytest

from optodrive.cli.main import run
from optodrive.device.config_file import load_config, locate_shipped
from optodrive.link.board_setup import build_board_requirements
from optodrive.planning.display_model import DisplayModel

OPTIONS = {"rows": 6, "columns": 6, "pitch-mm": 4, "power-w": 1.2, "lens-mm": 160, "port": "simulated"}


def write(path, **changes):
    """Run the command. Return its exit status. A change to None leaves an option out."""
    options = OPTIONS | {key.replace("_", "-"): value for key, value in changes.items()}
    words = [f"--{key}={value}" for key, value in options.items() if value is not None]
    return run(["config", "new", str(path), *words])


def test_the_file_is_that_of_the_display(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    assert write(path) == 0
    assert f"optodrive serve --config {path}" in capsys.readouterr().out
    config = load_config(path)
    assert (config.name, config.display.rows, config.display.columns) == ("mine", 6, 6)
    assert (config.display.pitch_m, config.laser.max_power_w, config.scanner.focal_length_m) == (4e-3, 1.2, 0.16)
    assert (config.board.transport, config.limits.display_mean_power_max_w) == ("simulated", 1.2)
    assert run(["config", "check", "--config", str(path)]) == 0
    assert run(["config", "check", str(path)]) == 0
    assert run(["config", "check", str(path), "--config", str(path)]) == 2
    named = [line for line in path.read_text().splitlines() if "=" in line]
    assert sum("#" in line for line in named) > len(named) / 2, "most keys have a comment"


@pytest.mark.parametrize("kpps", [8, 20, 40])
def test_a_rating_covers_every_servo_that_earns_it(kpps, tmp_path):
    """At the rate of its points the circle of ILDA's test pattern falls by 3 dB, with any damping."""
    path = tmp_path / "mine.toml"
    assert write(path, kpps=kpps) == 0
    scanner = load_config(path).scanner
    low_hz, high_hz = (scanner.bandwidth_hz * (1 + sign * scanner.bandwidth_uncertainty) for sign in (-1, 1))
    low, high = (scanner.damping * (1 + sign * scanner.damping_uncertainty) for sign in (-1, 1))
    rated_hz, hz = kpps * 1000 / 12, np.arange(0.5, 2.0, 1e-3) * kpps * 1000 / 12
    for damping in np.linspace(0.5, 0.87, 12):
        gain = np.abs(1.0 / (1.0 - (rated_hz / hz) ** 2 + 2j * damping * rated_hz / hz))
        servo_hz = hz[np.argmin(np.abs(gain - 0.5**0.5))]
        assert low_hz <= servo_hz <= high_hz
        assert low <= damping <= high
    assert scanner.delay_s - scanner.delay_uncertainty_s == 0.0


def test_without_changes_it_is_the_template(tmp_path):
    path = tmp_path / "display-16.toml"
    assert write(path, rows=4, columns=4, power_w=2.45, lens_mm=220) == 0
    limits = {"pulse_energy_max_j": pytest.approx(0.1225)}  # 2.45 W for 50 ms
    written, shipped = load_config(path).model_dump(), load_config(locate_shipped("display-16.toml")).model_dump()
    assert written == shipped | {"limits": shipped["limits"] | limits}


@pytest.mark.parametrize(
    "changes",
    [
        {"rows": 1, "columns": 1},
        {"rows": 30, "columns": 2, "lens_mm": 300},
        {"pitch_mm": 2.1, "rows": 3, "columns": 3},
        {"pitch_mm": 12},
        {"power_w": 0.02},
        {"power_w": 40},
        {"lens_mm": 60},
        {"lens_mm": 800},
        {"port": "/dev/ttyACM0"},
    ],
    ids=str,
)
def test_the_file_is_valid_for_every_display(changes, tmp_path):
    path = tmp_path / "mine.toml"
    assert write(path, **changes) == 0
    config = load_config(path)
    DisplayModel.from_config(config)
    build_board_requirements(config)
    assert config.board.port == ("/dev/ttyACM0" if "port" in changes else "")


@pytest.mark.parametrize("pitch_mm", [1.5, 2.5, 3, 3.4, 3.49, 3.5, 4, 6])
def test_its_pixels_can_be_swept_at_every_pitch(pitch_mm, tmp_path):
    path = tmp_path / "mine.toml"
    assert write(path, pitch_mm=pitch_mm) == 0
    assert run(["calibrate", "pixels", "--sweep", str(tmp_path / "sweep"), "--config", str(path)]) == 0


def test_a_sweep_states_the_pitch_that_it_needs(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    assert write(path, pitch_mm=4) == 0
    wide = path.read_text()
    for pitch, status in (("0.0033", 2), ("0.0034", 0)):
        path.write_text(wide.replace("pitch_m = 0.004", f"pitch_m = {pitch}"))
        sweep = tmp_path / f"sweep{status}"
        assert run(["calibrate", "pixels", "--sweep", str(sweep), "--config", str(path)]) == status
        assert sweep.exists() == (status == 0)
    assert "display.pitch_m: got 0.0033, expected at least 0.0034, so that" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"lens_mm": 10}, "--lens-mm: got 10.0, expected at least 28.65 mm"),
        ({"rows": None}, "--rows: missing, expected --rows, because without a terminal nobody can answer"),
        ({"rows": 0}, "'--rows'"),
        ({"power_w": 1200}, "--power-w: got 1200.0, expected 0.001 to 60 W; this value is likely in mW"),
        ({"power_w": -1}, "--power-w: got -1.0, expected 0.001 to 60 W\n"),
        ({"power_w": "nan"}, "--power-w: got nan, expected 0.001 to 60 W\n"),
        ({"pitch_mm": 0.004}, "--pitch-mm: got 0.004, expected 0.1 to 100 mm; this value is likely in m\n"),
        ({"lens_mm": 0.22}, "--lens-mm: got 0.22, expected 5 to 3000 mm; this value is likely in m\n"),
        ({"port": "COM3"}, "--port: got 'COM3', expected a serial device"),
        ({"port": ""}, "--port: got ''"),
    ],
    ids=str,
)
def test_what_no_display_has_is_refused_in_one_line(changes, says, tmp_path, capsys):
    path = tmp_path / "mine.toml"
    assert write(path, **changes) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_no_file_is_overwritten(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    path.write_text("mine")
    assert write(path) == 2
    assert "expected a new file; this one exists" in capsys.readouterr().err
    assert path.read_text() == "mine"


def test_a_terminal_is_asked_for_what_no_option_states(tmp_path):
    path, (terminal, theirs) = tmp_path / "mine.toml", os.openpty()
    command = [
        sys.executable,
        "-m",
        "optodrive.cli.main",
        "config",
        "new",
        str(path),
        "--rows",
        "5",
        "--lens-mm",
        "160",
    ]
    with subprocess.Popen(command, stdin=theirs, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as asking:
        os.close(theirs)
        os.write(terminal, b"3\n\n1.2\n\n")
        _, questions = asking.communicate()
    os.close(terminal)
    assert asking.returncode == 0, questions
    assert [questions.count(word) for word in ("Rows", "Columns", "Distance", "Power", "Focal", "Serial")] == [
        0,
        1,
        1,
        1,
        0,
        1,
    ]
    config = load_config(path)
    assert (config.display.rows, config.display.columns, config.laser.max_power_w) == (5, 3, 1.2)
    assert config.board.transport == "simulated"


def test_a_wrong_answer_is_asked_again_and_costs_none_of_the_others(tmp_path):
    path, (terminal, theirs) = tmp_path / "mine.toml", os.openpty()
    answers = [
        "0",
        "2.5",
        "6",
        "7",
        "0.003",
        "3",
        "1.6 W",
        "-3",
        "1600",
        "1.6",
        "abc",
        "20",
        "100",
        "COM3",
        "/dev/ttyACM0",
    ]
    command = [sys.executable, "-m", "optodrive.cli.main", "config", "new", str(path)]
    with subprocess.Popen(command, stdin=theirs, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as asking:
        os.close(theirs)
        os.write(terminal, "".join(f"{answer}\n" for answer in answers).encode())
        _, questions = asking.communicate()
    os.close(terminal)
    assert asking.returncode == 0, questions
    refused = questions.split("optodrive: ")[1:]
    assert [line.partition(", expected")[0] for line in refused] == [
        "--rows: got 0",
        "--rows: got '2.5'",
        "--pitch-mm: got 0.003",
        "--power-w: got '1.6 W'",
        "--power-w: got -3.0",
        "--power-w: got 1600.0",
        "--lens-mm: got 'abc'",
        "--lens-mm: got 20.0",
        "--port: got 'COM3'",
    ]
    config = load_config(path)
    assert (config.display.rows, config.display.columns, config.display.pitch_m) == (6, 7, 3e-3)
    assert (config.laser.max_power_w, config.scanner.focal_length_m) == (1.6, 0.1)
    assert config.board.port == "/dev/ttyACM0"


@pytest.mark.parametrize(
    ("port", "transport", "address"),
    [("ether_dream:192.168.1.20", "ether_dream", "192.168.1.20"), ("idn:dac", "idn", "dac"), ("helios", "helios", "")],
)
def test_a_laser_dac_gets_its_keys_and_no_permission(tmp_path, capsys, port, transport, address):
    path = tmp_path / "mine.toml"
    assert write(path, port=port) == 0
    config = load_config(path)
    assert (config.board.transport, config.board.port, config.board.interlock_watched) == (transport, address, False)
    assert config.scanner.half_range_codes == 2047
    assert run(["config", "check", "--config", str(path)]) == 0
    capsys.readouterr()
    assert run(["serve", "--config", str(path)]) == 2
    assert "true once an external interlock cuts the laser" in capsys.readouterr().err


@pytest.mark.parametrize("port", ["ether_dream", "helios:1", "idn:", "ftp:dac"])
def test_a_port_of_no_device_is_refused(tmp_path, capsys, port):
    assert write(tmp_path / "mine.toml", port=port) == 2
    assert "helios, ether_dream:ADDRESS or idn:ADDRESS for a laser DAC" in capsys.readouterr().err
