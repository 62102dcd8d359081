"""`optodrive service install | remove | show` below a temporary root."""

import contextlib
import fcntl
import json
import os
import re
from pathlib import Path

import pytest

from optodrive.cli.main import run
from optodrive.cli.service_files import (
    CONFIG_PATH,
    UNIT_PATH,
    Installation,
    ServiceFile,
    ServicePaths,
)
from optodrive.core.errors import RefusedError
from optodrive.device.config_file import load_config, locate_shipped
from optodrive.device.pixel_map import PixelMap, write_pixel_map
from optodrive.planning import heat_record
from optodrive.planning.display_model import DisplayModel

MANIFEST_PATH, RULES_PATH, USERS_PATH = ServicePaths().manifest, ServicePaths().rules, ServicePaths().users
PROGRAM = "/opt/optodrive/bin/optodrive"
USB_BOARD = 'transport = "serial"\nport = "/dev/optodrive-board"\nvendor_id = 0x2e8a\nproduct_id = 0x000a\n'


@pytest.fixture
def install(tmp_path, capsys):
    def run_service(*arguments, command="install", status=0):
        program = ["--program", PROGRAM] if command == "install" and "--program" not in arguments else []
        assert run(["service", command, "--root", str(tmp_path / "root"), *program, *map(str, arguments)]) == status
        return capsys.readouterr()

    return run_service


@pytest.fixture
def at(tmp_path):
    return lambda path: tmp_path / "root" / path.relative_to("/")


def board_config(folder, board):
    text = locate_shipped("display-437.toml").read_text()
    path = folder / "mine.toml"
    path.write_text(text.replace('transport = "simulated"', board))
    return path


def test_what_is_written_is_in_order(install, at):
    output = install().out
    assert all(at(path).is_file() for path in (UNIT_PATH, USERS_PATH, CONFIG_PATH, MANIFEST_PATH))
    assert f"ExecStart={PROGRAM} serve --config {CONFIG_PATH}\n" in at(UNIT_PATH).read_text()
    assert not re.search(r"@[A-Z]+@", at(UNIT_PATH).read_text())
    daemon = load_config(at(CONFIG_PATH)).daemon
    assert (daemon.socket, daemon.tokens, daemon.audit) == (
        "/run/optodrive/optodrive.sock",
        "/var/lib/optodrive/tokens.toml",
        "/var/lib/optodrive/audit.jsonl",
    )
    assert daemon.host == "127.0.0.1"
    assert "enable --now" in output
    assert "only `optodrive arm` arms" in output


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        ("[daemon]\nport = 9000\n", ("/run/optodrive/optodrive.sock", "/var/lib/optodrive/tokens.toml", 9000)),
        ("[ daemon ] # ours\nport = 9000", ("/run/optodrive/optodrive.sock", "/var/lib/optodrive/tokens.toml", 9000)),
        ('[daemon]\nsocket = ""\n', ("", "/var/lib/optodrive/tokens.toml", 8450)),
        ('[daemon]\ntokens = "/srv/tokens"\n', ("/run/optodrive/optodrive.sock", "/srv/tokens", 8450)),
        ("[daemon]", ("/run/optodrive/optodrive.sock", "/var/lib/optodrive/tokens.toml", 8450)),
    ],
)
def test_keys_that_the_daemon_section_does_not_state_are_those_of_the_service(install, at, tmp_path, section, expected):
    path = board_config(tmp_path, USB_BOARD)
    path.write_text(f"{path.read_text()}\n{section}")
    install("--config", path)
    daemon = load_config(at(CONFIG_PATH)).daemon
    assert (daemon.socket, daemon.tokens, daemon.port) == expected
    assert daemon.audit == "/var/lib/optodrive/audit.jsonl"
    assert section.splitlines()[0] in at(CONFIG_PATH).read_text()


def test_the_record_of_heat_is_that_of_the_machine(install, at):
    """With a folder of its own, or without the identity of the computer's run, each start would be hot."""
    install()
    unit = at(UNIT_PATH).read_text()
    assert f"ExecStartPre=+mkdir -p -m 1777 {heat_record.FOLDER}\n" in unit
    assert f"BindPaths=-{heat_record.FOLDER}\n" in unit
    assert "\nProcSubset" not in unit


def test_a_daemon_table_in_one_line_is_refused_with_the_missing_keys(install, at, tmp_path):
    path = board_config(tmp_path, USB_BOARD)
    path.write_text(path.read_text().replace("\nname", '\ndaemon = { port = 9000, audit = "" }\nname', 1))
    error = install("--config", path, status=2).err
    assert f"{path}: daemon" in error
    assert "a section [daemon], or all of socket, tokens" in error
    assert not at(CONFIG_PATH).exists()


def test_once_more_changes_nothing(install, at):
    install()
    before = {
        path: (at(path).read_text(), at(path).stat().st_mtime_ns) for path in (UNIT_PATH, USERS_PATH, CONFIG_PATH)
    }
    assert install().out.count("unchanged") == 3
    assert before == {
        path: (at(path).read_text(), at(path).stat().st_mtime_ns) for path in (UNIT_PATH, USERS_PATH, CONFIG_PATH)
    }


def test_an_edited_unit_is_not_overwritten_and_nothing_else_is(install, at):
    install()
    at(UNIT_PATH).write_text("[Service]\nNice=0\n")
    at(USERS_PATH).unlink()
    output = install("--program", "/opt/other/optodrive", status=1).err
    assert output.count("\n") == 1
    assert str(at(UNIT_PATH)) in output
    assert at(UNIT_PATH).read_text() == "[Service]\nNice=0\n"
    assert not at(USERS_PATH).exists()


def test_a_file_that_somebody_else_put_there_is_not_overwritten(install, at):
    at(USERS_PATH).parent.mkdir(parents=True)
    at(USERS_PATH).write_text("u other\n")
    install(status=1)
    assert at(USERS_PATH).read_text() == "u other\n"
    assert not at(UNIT_PATH).exists()


def own_config(folder, **named):
    """Write a configuration that names files, by sections and keys as `section__key`. Return its path."""
    text = locate_shipped("display-16.toml").read_text()
    for place, name in named.items():
        section, key = place.split("__")
        text = re.sub(rf'(?m)^{key} = "[^"]*"', "", text).replace(f"[{section}]", f'[{section}]\n{key} = "{name}"')
    path = folder / "own" / "mine.toml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


def test_files_that_the_configuration_names_are_installed_beside_it(install, at, tmp_path):
    """In a folder that is not the caller's, and so that the installed configuration loads everything it names."""
    names = {"scanner__mirrors": "servo/mirrors.toml", "display__pixel_map": "pixels.toml"}
    path = own_config(tmp_path, pixel_model__parameters="model.toml", **names)
    (path.parent / "servo").mkdir()
    config = load_config("display-16")
    mirrors = "\n".join(
        f"{key} = {getattr(config.scanner, key)!r}" for key in ("bandwidth_hz", "damping", "delay_s", "slew_rad_per_s")
    )
    (path.parent / "servo/mirrors.toml").write_text(
        f'format = "optodrive-mirrors"\nversion = 1\n[scanner]\n{mirrors}\n[galvo]\nshare = 0.9\n'
    )
    parameters = locate_shipped("parameters", "surroundings.toml").read_text()
    (path.parent / "model.toml").write_text(parameters)
    write_pixel_map(path.parent / "pixels.toml", PixelMap.uniform(16, 0.0, 0.0), config, {})
    output = install("--config", path).out
    folder = CONFIG_PATH.parent
    assert all(f"{folder / name}: written" in output for name in ("servo/mirrors.toml", "pixels.toml", "model.toml"))
    installed = DisplayModel.from_config(load_config(at(CONFIG_PATH)))
    assert installed.config.limits.galvo_acceleration_rms_max_rad_per_s2 == 9e4
    assert at(folder / "model.toml").read_text() == parameters

    at(folder / "model.toml").write_text(f"{parameters}\n# ours\n")
    assert f"{folder / 'model.toml'}: edited, kept" in install().out
    install(command="remove")
    assert sorted(each.name for each in at(folder).iterdir() if each.is_file()) == ["installed.json", "model.toml"]


def test_a_named_pipe_or_device_is_refused_without_waiting(install, tmp_path):
    """A calibrated field is not read before: the command did not end, or took all memory."""
    path = own_config(tmp_path, scanner__field="field.toml")
    for make in (os.mkfifo, lambda field: field.symlink_to("/dev/zero")):
        make(path.parent / "field.toml")
        error = install("--config", path, status=2).err
        assert "field.toml: got a" in error
        assert error.count("\n") == 1
        (path.parent / "field.toml").unlink()


@pytest.mark.parametrize("name", ["../field.toml", "config.toml", "installed.json", "absent.toml"])
def test_a_named_file_that_cannot_be_installed_is_refused(install, at, tmp_path, name):
    error = install("--config", own_config(tmp_path, scanner__field=name), status=2).err
    assert name in error
    assert error.count("\n") == 1
    assert not at(UNIT_PATH).exists()


def test_an_upgrade_replaces_what_was_not_edited_and_keeps_the_configuration(install, at, tmp_path):
    install("--config", "display-16")
    assert install("--program", "/opt/new/optodrive").out.count("replaced") == 1
    assert "/opt/new/optodrive" in at(UNIT_PATH).read_text()
    assert load_config(at(CONFIG_PATH)).name == "display-16"
    at(CONFIG_PATH).write_text(at(CONFIG_PATH).read_text().replace("ambient_c = 20.0", "ambient_c = 25.0"))
    output = install("--program", "/opt/newer/optodrive").out
    assert f"{CONFIG_PATH}: edited, kept" in output
    assert load_config(at(CONFIG_PATH)).ambient_c == 25.0


def test_remove_leaves_what_was_edited(install, at):
    install()
    at(CONFIG_PATH).write_text(at(CONFIG_PATH).read_text() + "# mine\n")
    output = install(command="remove").out
    assert f"{CONFIG_PATH}: edited, kept" in output
    unit = at(UNIT_PATH).name
    for folder in ("/var/lib/optodrive", "/var/cache/optodrive"):
        assert folder in output, unit
    assert not at(UNIT_PATH).exists()
    assert at(CONFIG_PATH).exists()
    at(CONFIG_PATH).unlink()
    install(command="remove")
    assert not at(MANIFEST_PATH).exists()
    assert install(command="remove").out == "nothing is installed\n"


def test_show(install, at):
    assert install(command="show").out == "nothing is installed\n"
    install()
    at(UNIT_PATH).write_text("")
    at(USERS_PATH).unlink()
    shown = json.loads(install("--json", command="show").out)["files"]
    assert {item["path"]: item["status"] for item in shown} == {
        str(UNIT_PATH): "edited",
        str(USERS_PATH): "missing",
        str(CONFIG_PATH): "as installed",
    }


def test_rules_name_the_board(install, at, tmp_path):
    install("--config", board_config(tmp_path, USB_BOARD + 'serial_number = "E6-1"\n'))
    lines = [line for line in at(RULES_PATH).read_text().splitlines() if "idVendor" in line]
    assert len(lines) == 2
    for line in lines:
        for part in (
            'ATTRS{idVendor}=="2e8a"',
            'ATTRS{idProduct}=="000a"',
            'ATTRS{serial}=="E6-1"',
            'ENV{ID_MM_DEVICE_IGNORE}="1"',
            'GROUP="dialout"',
            'MODE="0660"',
        ):
            assert part in line
    assert 'SYMLINK+="optodrive-board"' in lines[0]


@pytest.mark.parametrize("serial", ['x", RUN+="/bin/sh', "a b", "ü", "a$b"])
def test_a_serial_number_that_is_more_than_one_is_refused(install, at, tmp_path, serial):
    quoted = json.dumps(serial, ensure_ascii=False)
    output = install("--config", board_config(tmp_path, f"{USB_BOARD}serial_number = {quoted}\n"), status=2).err
    assert "board.serial_number" in output
    assert not at(UNIT_PATH).exists()


@pytest.mark.parametrize("program", ["/home/anna/.venv/bin/optodrive", "/root/x/optodrive", "/tmp/optodrive"])
def test_a_program_that_the_service_cannot_see_is_refused(install, program):
    assert "--program" in install("--program", program, status=1).err


@pytest.mark.parametrize("program", ["optodrive", "/opt/a b/optodrive", "/opt/%h/optodrive", "/opt/x\nUser=root"])
def test_a_program_that_is_more_than_a_path_is_refused(install, program):
    assert install("--program", program, status=2).err.count("\n") == 1


def test_only_a_board_on_usb_gets_usb_devices(install, at, tmp_path):
    install()
    assert "usb_device" not in at(UNIT_PATH).read_text()
    install("--config", board_config(tmp_path, USB_BOARD.replace('"serial"', '"usb"')))
    assert "DeviceAllow=char-usb_device rw\n" in at(UNIT_PATH).read_text()


STAGES = """
[[stages]]
name = "left"
board.transport = "serial"
board.port = "/dev/optodrive-board-left"
board.vendor_id = 0x2e8a
board.product_id = 0x000a
board.serial_number = "A"
[[stages]]
name = "right"
board.transport = "usb"
board.vendor_id = 0x1209
board.product_id = 0x0001
"""


def test_unit_and_rules_are_made_from_all_ports(install, at, tmp_path, monkeypatch):
    path = tmp_path / "mine.toml"
    path.write_text(f'{locate_shipped("display-437.toml").read_text()}{STAGES}[sensor]\nport = "/dev/serial0"\n')
    targets = {"/dev/serial0": "/dev/ttyAMA0"}
    realpath = os.path.realpath
    monkeypatch.setattr("os.path.realpath", lambda path, **options: targets.get(path) or realpath(path, **options))
    assert "warning" not in install("--config", path).out
    unit, rules = at(UNIT_PATH).read_text(), at(RULES_PATH).read_text()
    allowed = {line.split("=")[1] for line in unit.splitlines() if line.startswith("DeviceAllow=")}
    assert allowed == {f"char-{each} rw" for each in ("ttyACM", "ttyUSB", "ttyAMA", "usb_device")}
    assert re.search(r"^After=.*modprobe@cdc_acm.service modprobe@usbserial.service$", unit, re.MULTILINE)
    left, _, right, _ = [line for line in rules.splitlines() if "idVendor" in line]
    assert 'ATTRS{serial}=="A"' in left
    assert 'SYMLINK+="optodrive-board-left"' in left
    assert 'SYMLINK+="optodrive-board-right"' in right


@pytest.mark.parametrize(
    ("port", "allowed"),
    [
        ("/dev/ttyS0", "ttyS"),
        ("/dev/ttyAMA1", "ttyAMA"),
        ("/dev/ttyTHS1", "ttyTHS"),
        ("/dev/ttyACM3", None),
        ("/dev/serial/by-id/usb-x", None),
    ],
)
def test_a_port_that_is_not_on_usb_is_allowed(install, at, tmp_path, port, allowed):
    assert "warning" not in install("--config", board_config(tmp_path, f'transport = "serial"\nport = "{port}"\n')).out
    assert at(UNIT_PATH).read_text().count("DeviceAllow=") == 2 + (allowed is not None)
    assert (f"DeviceAllow=char-{allowed} rw\n" in at(UNIT_PATH).read_text()) is (allowed is not None)


def test_a_port_of_an_unknown_class_is_named(install, tmp_path):
    output = install("--config", board_config(tmp_path, 'transport = "serial"\nport = "/dev/my-board"\n')).out
    assert "warning: board.port = /dev/my-board is not present" in output


def test_a_service_of_another_display_is_not_replaced(install, at, tmp_path):
    install()
    other = tmp_path / "other.toml"
    other.write_text(locate_shipped("display-16.toml").read_text())
    before = at(CONFIG_PATH).read_text()
    refused = install("--config", other, status=1).err
    assert "this service drives display-437, the configuration is of display-16" in refused
    assert at(CONFIG_PATH).read_text() == before
    install(command="remove")
    install("--config", other)
    assert load_config(at(CONFIG_PATH)).name == "display-16"


def test_two_displays_have_a_service_each(install, at, tmp_path):
    other = board_config(tmp_path, USB_BOARD)
    text = other.read_text().replace('name = "display-437"', 'name = "second"')
    other.write_text(text)
    install()
    refused = install("--config", other, "--name", "second", status=1).err
    assert "this service has daemon.port 8450, too" in refused
    other.write_text(text + "[daemon]\nport = 8001\n")
    output = install("--config", other, "--name", "second").out
    assert "systemctl enable --now optodrive@second" in output
    paths = ServicePaths("second")
    one, two = at(UNIT_PATH).read_text(), at(paths.unit).read_text()
    assert paths.unit.name == "optodrive@second.service"
    for key in ("RuntimeDirectory", "StateDirectory", "ExecStart"):
        values = {re.search(rf"^{key}=(.*)$", unit, re.MULTILINE)[1] for unit in (one, two)}
        assert len(values) == 2, key
    daemons = [load_config(at(path)).daemon for path in (CONFIG_PATH, paths.config)]
    for key in ("socket", "tokens", "audit", "port"):
        assert getattr(daemons[0], key) != getattr(daemons[1], key)
    assert 'SYMLINK+="optodrive-board-second"' in at(paths.rules).read_text()
    third = install("--config", other, "--name", "third", status=1).err
    assert "daemon.port 8001" in third
    other.write_text(other.read_text().replace("port = 8001", "port = 8002"))
    assert "has the board serial /dev/optodrive-board" in install("--config", other, "--name", "third", status=1).err
    assert "udevadm control --reload" in install("--name", "second", command="remove").out
    assert at(UNIT_PATH).read_text() == one
    assert not at(paths.unit).exists()
    assert not at(paths.rules).exists()
    for command in ("show", "remove"):
        output = install("--name", "second", command=command).out
        assert output == "nothing is installed of this name; there is optodrive\n"


def test_the_last_service_leaves_no_folder_of_its_own(install, at, tmp_path):
    other = board_config(tmp_path, 'transport = "simulated"')
    other.write_text(other.read_text().replace('name = "display-437"', 'name = "second"') + "[daemon]\nport = 8001\n")
    install()
    install("--config", other, "--name", "second")
    install(command="remove")
    assert install(command="show").out == "nothing is installed of this name; there is optodrive@second\n"
    folder = at(CONFIG_PATH).parent
    assert [path.name for path in folder.iterdir()] == ["second"]
    install("--name", "second", command="remove")
    assert not folder.exists()
    install()
    (folder / "notes.txt").write_text("of somebody else")
    install(command="remove")
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("name", ["", "a b", "../x", "A", "-x", "x\n", "a" * 33])
def test_a_name_that_is_no_part_of_a_path_is_refused(install, name):
    assert "--name" in install(f"--name={name}", status=2).err


def test_a_root_that_may_not_be_written_is_one_line(install, tmp_path):
    (tmp_path / "root").write_text("a file")
    output = install(status=2).err
    assert output.count("\n") == 1


def test_an_installation_that_failed_goes_on_with_another_program(install, at):
    """The files are remembered before they are written; the unit was taken for somebody else's."""
    at(USERS_PATH).parent.parent.mkdir(parents=True)
    at(USERS_PATH).parent.write_text("a file in place of the folder")
    install(status=2)
    assert at(UNIT_PATH).exists()
    at(USERS_PATH).parent.unlink()
    assert f"{UNIT_PATH}: replaced" in install("--program", "/opt/other/optodrive").out


@pytest.mark.parametrize("writes", range(4))
def test_an_upgrade_that_was_killed_anywhere_is_made_again_by_any_version(tmp_path, monkeypatch, writes):
    def upgrade(version):
        return Installation(tmp_path).install(
            [ServiceFile(UNIT_PATH, f"unit {version}\n"), ServiceFile(USERS_PATH, f"users {version}\n")]
        )

    left, replace = [None] * writes, Path.replace

    def replace_or_die(*arguments):
        if not left:
            raise KeyboardInterrupt
        left.pop()
        return replace(*arguments)

    upgrade(1)
    with monkeypatch.context() as patch, contextlib.suppress(KeyboardInterrupt):
        patch.setattr(Path, "replace", replace_or_die)
        upgrade(2)
    assert {action for _, action in upgrade(3)} == {"replaced"}
    (tmp_path / UNIT_PATH.relative_to("/")).write_text("unit 1\n# mine\n")
    with pytest.raises(RefusedError, match="edited"):
        upgrade(4)


def test_a_list_of_files_that_nests_too_deep_is_refused(install, at):
    install()
    at(MANIFEST_PATH).write_text("[" * 100_000)
    assert install(command="show", status=2).err.count("\n") == 1


def test_a_program_that_is_absent_here_is_refused_for_the_service_of_this_computer(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(Installation, "install", lambda *arguments: pytest.fail("written"))
    (tmp_path / "text").write_text("no program")
    for program in (tmp_path / "absent", tmp_path / "text", tmp_path):
        assert run(["service", "install", "--program", str(program)]) == 2
        assert capsys.readouterr().err.startswith(f"optodrive: --program: got '{program}'"[:60])


def test_an_installation_knows_what_another_command_wrote_meanwhile(tmp_path):
    first, second = Installation(tmp_path), Installation(tmp_path)
    files = [ServiceFile(UNIT_PATH, "first\n"), ServiceFile(USERS_PATH, "users\n")]
    assert [action for _, action in first.install(files)] == ["written", "written"]
    later = [ServiceFile(UNIT_PATH, "second\n"), files[1]]
    assert [action for _, action in second.install(later)] == ["replaced", "unchanged"]
    assert [action for _, action in first.remove()] == ["removed", "removed"]
    assert second.install(files)[0][1] == "written"


def test_one_command_at_a_time_changes_the_files(tmp_path):
    """The folder is locked while files are written: who asks for the lock then does not get it."""
    installation, folder = Installation(tmp_path), tmp_path / MANIFEST_PATH.parent.relative_to("/")
    refused = []

    def probe(file):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            refused.append(file)
        finally:
            os.close(descriptor)
        return False

    installation._is_current = probe
    installation.install([ServiceFile(UNIT_PATH, "unit\n")])
    assert refused
