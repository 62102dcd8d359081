"""`optodrive doctor`: each check on a file tree that replaces the system, or on the real system."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from optodrive.cli import doctor_host as host
from optodrive.cli.doctor_board import check_board
from optodrive.cli.doctor_finding import report_ok
from optodrive.cli.doctor_port import check_port
from optodrive.cli.doctor_watch import INTERVAL_S, watch
from optodrive.cli.main import run
from optodrive.core.clock import ManualClock, MonotonicClock
from optodrive.device.config_file import load_config, locate_shipped
from optodrive.device.config_sections import BoardSection


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
    assert find_finding(findings, "board").status == "warning", "no uid is configured"
    uid = find_finding(findings, "board").remedy.split('"')[1]
    assert "DISARMED" in find_finding(findings, "board").observation
    assert {find_finding(findings, check).status for check in ("limits", "inputs")} == {"ok"}
    findings = check_board(simulated(uid=uid), MonotonicClock())
    assert find_finding(findings, "board").status == "ok"


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
