"""`optodrive board settings | build`: the image has the limits of its display, and its host accepts it."""

import json
import re
import subprocess
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path

import pytest
from bench import Bench
from emulated_pico import PORT, EmulatedPico, PicoImage, read_uf2
from virtual_board import PicoBoard, VirtualKind

from firmware_ports import require
from optodrive.cli.main import run
from optodrive.core.errors import InputError
from optodrive.device.config_file import load_config
from optodrive.lab.commissioning.exclusive_board import FIELD_MARGIN_M
from optodrive.link.board_setup import build_bench_requirements, build_board_requirements
from optodrive.link.pico_firmware import CELLS_MAX, GATE_MAX_HZ, GATE_MIN_HZ
from optodrive.link.protocol.messages import Limits

UID = "0123456789abcdef01234567"
CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture
def config(tmp_path):
    """Return a function that writes a shipped configuration with a serial board and other lines."""

    def write(name="display-16", uid=UID, name_of_display="", **replaced):
        text = (CONFIGS / f"{name}.toml").read_text()
        own = f'transport = "serial"\nport = "/dev/ttyACM0"\nuid = "{uid}"\n'
        text = re.sub(r'transport = "simulated".*\n', own, text)
        for key, line in replaced.items():
            text, count = re.subn(rf"^{key} = .*$", line, text, flags=re.MULTILINE)
            assert count == 1
        text = re.sub(r"^name = .*$", name_of_display, text, flags=re.MULTILINE) if name_of_display else text
        path = tmp_path / "own.toml"
        path.write_text(text)
        return path

    return write


@pytest.fixture
def built(config, tmp_path, monkeypatch):
    """Return the image of a display whose board has other limits than settings.h, as `board settings` states them."""
    path = config(bandwidth_hz="bandwidth_hz = 900.0", pulse_energy_max_j="pulse_energy_max_j = 0.1")
    header = tmp_path / "own.h"
    assert run(["board", "settings", "--config", str(path), "--out", str(header)]) == 0
    monkeypatch.setenv("SETTINGS", str(header))
    folder = tmp_path / "image"
    folder.mkdir()
    return path, PicoImage(folder)


@pytest.fixture
def bench(built, tmp_path):
    def make_core(settings, sink, seed):
        return EmulatedPico(built[1], None, sink, seed)

    bench = Bench(VirtualKind("pico", make_core, make_board=PicoBoard), tmp_path)
    yield bench
    bench.finish(lambda board: None)


def test_the_image_has_the_limits_of_its_display_and_its_host_accepts_it(built, bench):
    reply = bench.host(bench.board()).hello()
    reply.limits = Limits(*(getattr(reply, each.name) for each in fields(Limits)))
    loaded = load_config(str(built[0]))
    for build in (build_board_requirements, partial(build_bench_requirements, margin_m=FIELD_MARGIN_M)):
        build(loaded).check_board(reply)
    assert reply.uid.hex() == UID
    spare_uj = 1.06e6 * loaded.limits.pulse_energy_max_j
    assert loaded.limits.pulse_energy_max_j * 1e6 <= reply.limits.spot_uj <= spare_uj
    assert reply.capabilities == 1
    assert reply.limits.full_power_uw == round(1e6 * loaded.laser.max_power_w)
    digital = replace(build_board_requirements(loaded), interface="xy2-100")
    with pytest.raises(InputError, match=r"scanner\.interface: got 'xy2-100', expected analog, as this board"):
        digital.check_board(reply)
    with pytest.raises(InputError, match="expected a slower servo"):
        build_board_requirements(load_config("display-16")).check_board(reply)


def test_the_settings_state_the_interface(config, capsys):
    for interface, stated in (("analog", "INTERFACE_ANALOG"), ("xy2-100", "INTERFACE_XY2_100")):
        path = config(bandwidth_hz=f'interface = "{interface}"\nbandwidth_hz = 1000.0')
        assert run(["board", "settings", "--config", str(path)]) == 0
        assert f"    .interface = {stated},\n" in capsys.readouterr().out


def test_the_settings_state_half_of_the_largest_cell_of_measured_mirrors(config, capsys):
    path = config(bandwidth_hz="feedback = true\nbandwidth_hz = 1000.0")
    assert run(["board", "settings", "--config", str(path)]) == 0
    codes = build_board_requirements(load_config(str(path))).cell_max_codes // 2
    assert codes > 500
    assert f"    .feedback_codes = {codes},\n" in capsys.readouterr().out


def test_build_writes_this_image(built, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("SETTINGS")
    out = tmp_path / "board.uf2"
    assert run(["board", "build", str(out), "--config", str(built[0])]) == 0
    assert read_uf2(out) == built[1].flash
    printed = capsys.readouterr().out
    assert f"uid              {UID}\n" in printed
    assert "full power       declared: laser.max_power_w, 2.45 W" in printed
    assert run(["board", "build", str(out), "--config", str(built[0])]) == 2  # the file is there


@pytest.mark.parametrize("name", ["display-1", "display-16", "display-357", "display-437", "display-1511"])
def test_settings_of_every_shipped_display(config, capsys, name):
    assert run(["board", "settings", "--config", str(config(name)), "--json"]) == 0
    stated = json.loads(capsys.readouterr().out)
    requested = asdict(build_board_requirements(load_config(name)).limits)
    assert all(stated["limits"][key] <= requested[key] for key in ("x_min", "y_min", "settle_us", "rest_us"))
    assert all(stated["limits"][key] >= requested[key] for key in ("x_max", "y_max", "max_on_us", "spot_uj"))


def test_a_board_without_uid_gets_one_of_its_own(config, capsys):
    uids = set()
    for _ in range(2):
        run(["board", "settings", "--config", str(config(uid="")), "--json"])
        uids.add(json.loads(capsys.readouterr().out)["uid"])
    assert len(uids) == 2


@pytest.mark.parametrize(
    ("replaced", "says"),
    [
        ({"pwm_hz": "pwm_hz = 6e5"}, "laser.pwm_hz: got 600000.0, expected a frequency with a multiple from 30 kHz to"),
        (
            {"delay_s": 'interface = "xy2-100"\ndelay_s = 1e-5'},
            "scanner.delay_s: got 1e-05, expected at least 2e-05, two frames of scanner.interface 'xy2-100'",
        ),
        ({"uid": "zz"}, "board.uid: got 'zz', expected 24 hexadecimal digits"),
        ({"rows": "rows = 40", "columns": "columns = 40", "pitch_m": "pitch_m = 3.0e-3"}, f"at most {CELLS_MAX}"),
    ],
)
def test_a_display_that_a_pico_cannot_serve_is_refused_in_one_line(config, capsys, replaced, says):
    assert run(["board", "settings", "--config", str(config(**replaced))]) == 2
    err = capsys.readouterr().err
    assert says in err
    assert err.count("\n") == 1


def test_a_name_does_not_leave_its_comment(config, capsys):
    assert run(["board", "settings", "--config", str(config(name_of_display='name = "a*/ b /* c"'))]) == 0
    assert re.findall(r"/\*|\*/", capsys.readouterr().out) == ["/*", "*/"]


def test_without_a_compiler_it_says_what_to_install(config, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert run(["board", "build", str(tmp_path / "board.uf2"), "--config", str(config())]) == 2
    assert "PATH: got no compiler for the board, expected Debian's make gcc-arm" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("gate_hz", "builds"), [(GATE_MIN_HZ, True), (GATE_MAX_HZ, True), (29_999, False), (5e5, False)]
)
def test_the_firmware_refuses_a_frequency_that_its_pin_cannot_make(tmp_path, gate_hz, builds):
    require("arm-none-eabi-gcc", "make")
    header = tmp_path / "settings.h"
    header.write_text(re.sub(r"GATE_HZ \d+u", f"GATE_HZ {gate_hz:.0f}u", (PORT / "settings.h").read_text()))
    make = ["make", "-s", "-C", PORT, f"BUILD={tmp_path / 'build'}", f"SETTINGS={header}"]
    made = subprocess.run(make, capture_output=True, text=True)
    assert (made.returncode == 0) == builds, made.stderr
    assert builds or "GATE_HZ: 30,000 to 488,000" in made.stderr


def test_a_pico_has_the_spots_that_the_settings_count_on():
    assert f"-DBOARD_CELLS={CELLS_MAX}u" in (PORT / "Makefile").read_text()
