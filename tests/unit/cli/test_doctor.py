"""`optodrive doctor`: each check on a file tree that replaces the system, or on the real system."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import pytest

from optodrive.cli import doctor_host as host
from optodrive.cli.doctor import INTERVAL_S, watch
from optodrive.cli.doctor_board import check_board
from optodrive.cli.doctor_port import check_port
from optodrive.cli.main import run
from optodrive.cli.output import report_ok
from optodrive.core.clock import ManualClock, MonotonicClock
from optodrive.device.config_file import load_config, locate_shipped
from optodrive.device.config_sections import BoardSection
from optodrive.link.board_setup import build_port_settings
from optodrive.link.transport.simulated import SimulatedBoard


@pytest.fixture
def tmp_path():
    """A folder that other users can read. The folders of pytest are private to its user."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


SERIAL = BoardSection(transport="serial", port="/dev/ttyACM0")


@pytest.fixture
def tree(tmp_path):
    """A system with one board at /dev/ttyACM0 and no defect but the port's name."""
    for folder in ("dev/serial/by-id", "proc/77/fd", "sys/class/tty/ttyACM0/device", "run/udev/data"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "dev/ttyACM0").touch()
    (tmp_path / "dev/serial/by-id/usb-board").symlink_to("../../ttyACM0")
    (tmp_path / "proc/77/comm").write_text("bash\n")
    (tmp_path / "sys/class/tty/ttyACM0/dev").write_text("166:0\n")
    return tmp_path


def find_finding(findings, check):
    (finding,) = [finding for finding in findings if finding.check == check]
    return finding


def port_findings(tree, board=SERIAL):
    return check_port(board, tree)


def test_a_board_without_a_serial_port_has_no_port_to_check(tree):
    board = BoardSection(transport="usb", vendor_id=0x1209, product_id=1)
    assert [finding.observation for finding in check_port(board, tree)[0]] == ["none: transport usb"]


def test_a_port_in_order_may_be_asked_and_is_better_named_by_id(tree):
    findings, free = port_findings(tree)
    assert free
    assert find_finding(findings, "name").status == "warning"
    assert 'board.port = "/dev/serial/by-id/usb-board"' in find_finding(findings, "name").remedy
    assert {finding.status for finding in findings if finding.check != "name"} == {"ok"}
    by_id = BoardSection(transport="serial", port="/dev/serial/by-id/usb-board")
    findings, free = port_findings(tree, by_id)
    assert free
    assert {finding.status for finding in findings} == {"ok"}
    shutil.rmtree(tree / "dev/serial")
    assert "no by-id link" in find_finding(port_findings(tree)[0], "name").remedy


def test_a_port_that_is_not_there_names_those_that_are(tree):
    (tree / "dev/ttyACM0").rename(tree / "dev/ttyACM1")
    (finding,), free = port_findings(tree)
    assert not free
    assert finding.status == "problem"
    assert "/dev/ttyACM1" in finding.observation


def test_a_held_port_is_left_alone_and_its_holder_named(tree):
    (tree / "proc/77/fd/5").symlink_to("/dev/ttyACM0")
    findings, free = port_findings(tree)
    assert not free
    assert find_finding(findings, "holder").status == "warning"
    assert "bash, process 77" in find_finding(findings, "holder").observation
    (tree / "proc/77/comm").write_text("ModemManager\n")
    assert find_finding(port_findings(tree)[0], "holder").status == "problem"


def test_modem_manager_is_a_warning_unless_told_to_ignore_the_port(tree):
    (tree / "proc/77/comm").write_text("ModemManager\n")
    finding = find_finding(port_findings(tree)[0], "modem manager")
    assert finding.status == "warning"
    assert "ID_MM_DEVICE_IGNORE" in finding.remedy
    (tree / "run/udev/data/c166:0").write_text("S:serial/by-id/usb-board\nE:ID_MM_DEVICE_IGNORE=1\n")
    assert find_finding(port_findings(tree)[0], "modem manager").status == "ok"


@pytest.mark.parametrize(("text", "status"), [("16\n", "warning"), ("1\n", "ok"), ("?", "ok")])
def test_the_latency_timer_of_an_ftdi_converter(tree, text, status):
    (tree / "sys/class/tty/ttyACM0/device/latency_timer").write_text(text)
    assert find_finding(port_findings(tree)[0], "latency").status == status


def test_missing_permission_for_real(tree):
    path = tree / "dev/ttyACM0"
    path.chmod(0o000)
    was = os.geteuid()
    if was == 0:
        os.seteuid(65534)
    try:
        findings, free = port_findings(tree)
    finally:
        os.seteuid(was)
    assert not free
    assert find_finding(findings, "permission").status == "problem"
    assert f"usermod -aG {path.group()}" in find_finding(findings, "permission").remedy


def test_a_pty_held_by_another_process_for_real(tmp_path):
    master, slave = os.openpty()
    board = BoardSection(transport="serial", port=os.ttyname(slave))
    os.close(slave)
    code = "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(flush=True); sys.stdin.read()"
    assert check_port(board)[1]
    with subprocess.Popen(
        [sys.executable, "-c", code, board.port], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        process.stdout.readline()
        findings, free = check_port(board)
        process.stdin.close()
    assert not free
    assert f"process {process.pid}" in find_finding(findings, "holder").observation
    os.close(master)


class SlowClock(ManualClock):
    """A clock whose sleeps overshoot by `delay_s`."""

    def __init__(self, delay_s):
        super().__init__()
        self.delay_s = delay_s

    def sleep(self, duration_s):
        super().sleep(duration_s + self.delay_s)


@pytest.mark.parametrize(("late_s", "status"), [(0.0, "ok"), (0.009, "ok"), (0.011, "warning"), (0.06, "problem")])
def test_a_computer_that_wakes_late(late_s, status):
    finding = host.check_clock(SlowClock(late_s), lease_s=0.1)
    assert finding.status == status
    assert f"{late_s * 1e3:.2f} ms" in finding.observation


@pytest.mark.parametrize(
    ("governors", "status"),
    [((), "ok"), (("performance",) * 2, "ok"), (("performance", "powersave"), "warning"), (("schedutil",), "ok")],
)
def test_the_processor_s_governor(tmp_path, governors, status):
    for k, governor in enumerate(governors):
        folder = tmp_path / f"sys/devices/system/cpu/cpu{k}/cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_governor").write_text(governor + "\n")
    assert host.check_governor(tmp_path).status == status


@pytest.mark.parametrize(("free_bytes", "status"), [(5e9, "ok"), (5e8, "warning"), (1e7, "problem")])
def test_the_disk_s_room(free_bytes, status):
    assert host.check_free_space(Path("/var"), int(free_bytes)).status == status


def test_packages_missing_or_too_old_are_named():
    assert [finding.status for finding in host.check_packages()] == ["ok"]
    assert "not installed" in host.check_packages("no-such-package")[0].observation
    assert host._check_requirement("no-such-package>=1") == "no-such-package is missing"
    assert "older than 999" in host._check_requirement("numpy>=999")
    assert host._check_requirement("numpy[dev] >=1.2") is None
    assert host.check_python().status == "ok"


@pytest.mark.parametrize(
    ("writable", "cached", "status"), [(True, True, "ok"), (True, False, "warning"), (False, False, "warning")]
)
def test_the_compiled_kernels(monkeypatch, writable, cached, status):
    monkeypatch.setattr("optodrive.core.kernels.CACHED", writable)
    monkeypatch.setattr("optodrive.core.kernels.is_cached", lambda kernel: cached)
    assert host.check_kernels().status == status


# --- the board, and all of it ---------------------------------------------------------------------------------------


def simulated(**changes):
    config = load_config("display-16")
    return config.model_copy(update={"board": config.board.model_copy(update=changes)})


def test_the_simulated_board_is_greeted_and_not_armed():
    findings = check_board(simulated(), MonotonicClock())
    assert "DISARMED; the board is simulated" in find_finding(findings, "board").observation
    assert {find_finding(findings, check).status for check in ("board", "limits", "inputs")} == {"ok"}


def test_a_configuration_that_accepts_any_board_is_told_the_key_that_accepts_one(tmp_path):
    transport = SimulatedBoard(build_port_settings(load_config("display-16")))
    transport.open()
    transport.close()
    try:
        findings = check_board(simulated(transport="serial", port=transport.name), MonotonicClock())
        assert find_finding(findings, "board").status == "warning"
        key, section = (
            find_finding(findings, "board").remedy.removeprefix("to accept this board only: ").split(" in section ")
        )
        uid = tomllib.loads(f"{section}\n{key}")["board"]["uid"]
        findings = check_board(simulated(transport="serial", port=transport.name, uid=uid), MonotonicClock())
        assert find_finding(findings, "board").status == "ok"
    finally:
        transport.release()


def test_another_board_than_the_configured_one_is_a_problem():
    (finding,) = check_board(simulated(uid="ff" * 12), MonotonicClock())
    assert finding.status == "problem"
    assert "board.uid" in finding.observation


def test_the_command_exits_0_without_a_problem_and_1_with_one(tmp_path, capsys, monkeypatch):
    # The result of the clock check depends on the load of this computer.
    monkeypatch.setattr(host, "check_clock", lambda clock, lease_s: report_ok("clock", "skipped"))
    assert run(["doctor", "--config", "display-16", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["ok"]
    assert document["problems"] == 0
    assert {finding["status"] for finding in document["findings"]} <= {"ok", "warning"}
    text = locate_shipped("display-16.toml").read_text()
    path = tmp_path / "config.toml"
    path.write_text(text.replace('transport = "simulated"', f'transport = "serial"\nport = "{tmp_path}/tty"'))
    assert run(["doctor", "--config", str(path)]) == 1
    out = capsys.readouterr().out
    assert f"PROBLEM  port           {tmp_path}/tty does not exist" in out
    assert "1 problem, " in out
    path.write_text("format = 3")
    assert run(["doctor", "--config", str(path)]) == 1
    assert "PROBLEM  configuration" in capsys.readouterr().out


def test_a_stage_that_is_not_configured_is_refused_and_the_configuration_not_blamed(capsys):
    assert run(["doctor", "--config", "display-16", "--stage", "top"]) == 2
    assert capsys.readouterr().err == "optodrive: --stage: got 'top', expected none: the display has one stage\n"


def test_watch_reports_what_changed_and_no_numbers_that_vary(tree):
    clock, trips = ManualClock(), iter((0.4, 0.5, 0.6, 0.7))
    (tree / "run/udev/data/c166:0").write_text("E:ID_MM_DEVICE_IGNORE=1\n")

    def examine():
        return [*port_findings(tree)[0], report_ok("link", f"round trip {next(trips)} ms")]

    changes = watch(examine, clock)
    first = next(changes)
    assert {"port", "permission", "link"} <= {finding.check for finding in first}
    (tree / "dev/ttyACM0").unlink()
    (missing,) = next(changes)
    assert (missing.check, missing.status) == ("port", "problem")
    (tree / "dev/ttyACM0").touch()
    back = next(changes)
    assert "port" in {finding.check for finding in back}
    assert "link" not in {finding.check for finding in back}
    assert clock.now_s() == pytest.approx(2 * INTERVAL_S)


def test_watch_runs_until_it_is_interrupted(tmp_path):
    command = [sys.executable, "-m", "optodrive.cli.main", "doctor", "--watch", "--json", "--config", "nowhere.toml"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        line = json.loads(process.stdout.readline())
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate()
    assert process.returncode == 130
    assert errors == "optodrive: interrupted\n"
    assert "configuration" in {finding["check"] for finding in line["findings"]}


# --- names of adapters, and BRLTTY


def plug(tree, name, place, ids="1a86:7523", serial="", interface="1.0"):
    """Plug in an adapter: its port, by-path and by-id names, and its folder in sysfs."""
    (tree / f"dev/{name}").touch()
    device = tree / f"sys/devices/usb1/{place}"
    port = device / f"{place}:{interface}" / name
    port.mkdir(parents=True)
    for key, value in zip(("idVendor", "idProduct", "serial"), (*ids.split(":"), serial), strict=True):
        if value:
            (device / key).write_text(f"{value}\n")
    (tree / f"sys/class/tty/{name}").mkdir()
    (tree / f"sys/class/tty/{name}/device").symlink_to(port)
    for folder, link in (("by-path", f"usb-{place}"), ("by-id", f"usb-{ids}{serial}-{interface}")):
        (tree / f"dev/serial/{folder}").mkdir(exist_ok=True)
        path = tree / f"dev/serial/{folder}/{link}"
        path.unlink(missing_ok=True)
        path.symlink_to(f"../../{name}")
    return f"/dev/serial/by-id/usb-{ids}{serial}-{interface}"


def name_finding(tree, port):
    return find_finding(port_findings(tree, BoardSection(transport="serial", port=port))[0], "name")


@pytest.mark.parametrize(("serial", "says"), [("", "no serial number"), ("0001", "the serial number '0001'")])
def test_two_adapters_that_share_a_name_are_named_and_their_places_recommended(tree, serial, says):
    by_id = plug(tree, "ttyUSB0", "1-2", serial=serial)
    plug(tree, "ttyUSB1", "1-4", serial=serial)
    finding = name_finding(tree, by_id)
    assert finding.status == "problem"
    assert "/dev/ttyUSB1, /dev/ttyUSB0 are adapters of one kind (1a86:7523)" in finding.observation
    assert says in finding.observation
    assert finding.remedy == 'board.port = "/dev/serial/by-path/usb-1-4", the place of its plug'
    finding = name_finding(tree, "/dev/ttyUSB0")
    assert finding.status == "warning"
    assert 'board.port = "/dev/serial/by-path/usb-1-2"' in finding.remedy
    assert name_finding(tree, "/dev/serial/by-path/usb-1-2").status == "ok"


def test_one_adapter_without_a_serial_number_is_named_by_its_place(tree):
    finding = name_finding(tree, plug(tree, "ttyUSB0", "1-2"))
    assert finding.status == "warning"
    assert "without a serial number" in finding.observation
    assert "/dev/serial/by-path/usb-1-2" in finding.remedy


def test_adapters_that_differ_are_named_by_id(tree):
    by_id = plug(tree, "ttyUSB0", "1-2", serial="A1")
    plug(tree, "ttyUSB1", "1-4", serial="B2")
    plug(tree, "ttyUSB2", "1-5", ids="0403:6001", serial="A1")
    assert name_finding(tree, by_id).status == "ok"
    assert name_finding(tree, "/dev/ttyUSB0").remedy == f'board.port = "{by_id}"'


def test_two_ports_of_one_device_share_no_name(tree):
    by_id = plug(tree, "ttyUSB0", "1-2", serial="A1")
    port = tree / "sys/devices/usb1/1-2/1-2:1.2/ttyUSB1"
    port.mkdir(parents=True)
    (tree / "dev/ttyUSB1").touch()
    (tree / "sys/class/tty/ttyUSB1").mkdir()
    (tree / "sys/class/tty/ttyUSB1/device").symlink_to(port)
    assert name_finding(tree, by_id).status == "ok"


RULES = """
# Device: 1A86:7523
ENV{PRODUCT}=="1a86/7523/*", ENV{BRLTTY_BRAILLE_DRIVER}="bm", GOTO="brltty_usb_run"
ENV{PRODUCT}=="403/6001/*", ATTRS{manufacturer}=="Hedo Reha Technik GmbH", ENV{BRLTTY_BRAILLE_DRIVER}="hd"
# ENV{PRODUCT}=="10c4/ea60/*", ENV{BRLTTY_BRAILLE_DRIVER}="sk", GOTO="brltty_usb_run"
"""


@pytest.fixture
def brltty_tree(tree):
    (tree / "usr/lib/udev/rules.d").mkdir(parents=True)
    (tree / "usr/lib/udev/rules.d/85-brltty.rules").write_text(RULES)
    (tree / "etc/udev/rules.d").mkdir(parents=True)
    return tree


def brltty_findings(tree, port="/dev/ttyUSB0"):
    findings, _ = port_findings(tree, BoardSection(transport="serial", port=port))
    return [finding for finding in findings if finding.check == "brltty"]


@pytest.mark.parametrize(("ids", "count"), [("1a86:7523", 1), ("0403:6001", 0), ("10c4:ea60", 0)])
def test_an_adapter_that_brltty_takes_by_its_ids_is_named_before_it_vanishes(brltty_tree, ids, count):
    plug(brltty_tree, "ttyUSB0", "1-2", ids=ids)
    findings = brltty_findings(brltty_tree)
    assert len(findings) == count
    for finding in findings:
        assert finding.status == "warning"
        assert "the port then vanishes" in finding.observation
        assert "sudo ln -s /dev/null /etc/udev/rules.d/85-brltty.rules" in finding.remedy
    (brltty_tree / "etc/udev/rules.d/85-brltty.rules").symlink_to("/dev/null")
    assert not brltty_findings(brltty_tree)


@pytest.mark.parametrize("ids", ["1a86:7523", "0403:6001"])
def test_an_adapter_that_brltty_has_taken_is_named_where_its_port_is_missing(brltty_tree, ids):
    plug(brltty_tree, "ttyUSB0", "1-2", ids=ids)
    devices = brltty_tree / "sys/bus/usb/devices"
    devices.mkdir(parents=True)
    (devices / "1-2").symlink_to("../../../devices/usb1/1-2")
    drivers = brltty_tree / "sys/bus/usb/drivers"
    interface = brltty_tree / "sys/devices/usb1/1-2/1-2:1.0"
    for driver in ("ch341", "usbfs"):
        (drivers / driver).mkdir(parents=True)
    (interface / "driver").symlink_to(drivers / "ch341")
    (brltty_tree / "dev/ttyUSB0").unlink()
    shutil.rmtree(brltty_tree / "sys/class/tty/ttyUSB0")
    assert not brltty_findings(brltty_tree)
    (interface / "driver").unlink()
    (interface / "driver").symlink_to(drivers / "usbfs")
    (finding,) = brltty_findings(brltty_tree)
    assert finding.status == "problem"
    assert f"({ids}) is connected and has no serial port: a program has taken it" in finding.observation
    (brltty_tree / "proc/77/comm").write_text("brltty\n")
    (finding,) = brltty_findings(brltty_tree)
    assert "BRLTTY, which runs, has taken it" in finding.observation
    assert "end BRLTTY" in finding.remedy
