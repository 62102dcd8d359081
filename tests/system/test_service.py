"""The daemon as a systemd service: the unit, notifications, SIGHUP and the sandbox."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from forked_process import run_process
from optodrive.core.kernels import code_folder
from optodrive.device.config_file import locate_shipped
from rig import OPTODRIVE, TOKEN, Daemon, long_train, wait_for
from sandbox import build_sandboxed, find_obstacle
from service_manager import Manager, reload

TRANSPORTS = {
    "serial": 'transport = "serial"\nport = "/dev/optodrive-board"\nvendor_id = 0x2e8a\nproduct_id = 0x000a\n',
    "usb": 'transport = "usb"\nvendor_id = 0x2e8a\nproduct_id = 0x000a\n',
}
HEAD = 'format = "optodrive-tokens"\nversion = 1\n'
ENTRY = '[[token]]\nname = "{}"\nrole = "armer"\nsecret = "{}"\n'
EXPOSURE_MAX = "14"
"""Value of --threshold=, in tenths: 1.4."""


@pytest.fixture(params=sorted(TRANSPORTS))
def unit(request, tmp_path):
    """Return the unit as it is installed for a board."""
    config = tmp_path / "mine.toml"
    text = locate_shipped("display-437.toml").read_text()
    config.write_text(text.replace('transport = "simulated"', TRANSPORTS[request.param]))
    command = [OPTODRIVE, "service", "install", "--program", "/usr/bin/true"]
    run_process([*command, "--root", tmp_path / "root", "--config", config], check=True, capture_output=True)
    return tmp_path / "root/etc/systemd/system/optodrive.service"


def analyze(*arguments):
    program = shutil.which("systemd-analyze")
    assert program, "systemd-analyze is missing: apt-get install systemd"
    return subprocess.run([program, *arguments], capture_output=True, text=True)


def test_the_unit_is_valid(unit):
    done = analyze("verify", "--man=no", unit)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_the_exposure_of_the_unit_is_low(unit):
    done = analyze("security", "--offline=true", f"--threshold={EXPOSURE_MAX}", "--no-pager", unit)
    assert done.returncode == 0, done.stdout


def test_an_exposed_unit_is_detected(unit):
    unit.write_text(unit.read_text().replace("CapabilityBoundingSet=\n", "").replace("ProtectSystem=strict\n", ""))
    assert analyze("security", "--offline=true", f"--threshold={EXPOSURE_MAX}", "--no-pager", unit).returncode != 0


def test_an_invalid_unit_is_detected(unit):
    unit.write_text(unit.read_text().replace("WatchdogSec=20", "WatchdogSecs=20"))
    assert "WatchdogSecs" in analyze("verify", "--man=no", unit).stderr


# --- notifications -----------------------------------------------------------------------------------------------


@pytest.fixture
def manager(tmp_path, monkeypatch):
    manager = Manager(tmp_path, monkeypatch)
    yield manager
    manager.close()


def test_ready_then_watchdog_then_stopping(manager, board, make_daemon):
    daemon = make_daemon(board)
    wait_for(lambda: manager.listen().count("WATCHDOG=1") >= 5, "the watchdog to be fed")
    assert manager.heard.count("READY=1") == 1
    daemon.stop()
    assert "STOPPING=1" in manager.listen()
    assert daemon.process.returncode == 0


# --- SIGHUP -----------------------------------------------------------------------------------------------------


def test_sighup_applies_reloadable_keys_and_reports_the_others(manager, board, make_daemon):
    daemon = make_daemon(board)
    daemon.call("GET", "/v1/health", status=421, headers={"Host": "lab.example"})
    more = '\n[daemon]\nhosts = ["lab.example"]\nbody_max_bytes = 2000\n'
    said = reload(daemon, manager, lambda text: text.replace("ambient_c = 20.0", "ambient_c = 25.0") + more)
    assert said.count("\n") == 1
    assert "applied: daemon.body_max_bytes, daemon.hosts" in said
    assert "RESTART REQUIRED FOR: ambient_c" in said
    daemon.call("GET", "/v1/health", headers={"Host": "lab.example"})
    daemon.call("POST", "/v1/plans", status=413, content=b" " * 3000)
    assert daemon.call("GET", "/v1/config")["ambient_c"] == 20.0


def run_unit_reload(daemon):
    """Run the unit's ExecReload= commands one after the other until one fails, as systemd does. Return its result."""
    unit = locate_shipped("systemd", "optodrive.service").read_text()
    names = {"@PROGRAM@": OPTODRIVE, "@CONFIG@": daemon.config, "$MAINPID": daemon.process.pid}
    for command in re.findall(r"^ExecReload=(.+)$", unit, re.MULTILINE):
        words = [str(names.get(word, word)) for word in command.split()]
        done = run_process(words, capture_output=True, text=True)
        if done.returncode != 0:
            break
    return done


def test_a_reload_of_the_unit_fails_with_a_wrong_configuration(manager, board, make_daemon, tmp_path):
    daemon = make_daemon(board)
    good, before = daemon.config.read_text(), daemon.errors.read_text()
    tokens = tmp_path / "tokens.toml"
    tokens.write_text(HEAD + ENTRY.format("rig", TOKEN))
    tokens.chmod(0o644)
    for wrong, naming in (
        (good.replace("damping =", "dampin ="), "dampin"),
        (good + f'\n[daemon]\ntokens = "{tokens}"\n', "chmod 600"),
    ):
        daemon.config.write_text(wrong)
        done = run_unit_reload(daemon)
        assert done.returncode != 0
        assert done.stderr.count("\n") == 1
        assert naming in done.stderr
    assert "RELOADING=1" not in manager.listen()
    assert daemon.errors.read_text() == before
    daemon.config.write_text(good + '\n[daemon]\nhosts = ["lab.example"]\n')
    assert run_unit_reload(daemon).returncode == 0
    wait_for(lambda: manager.listen().count("READY=1") == 2, "the reload's end")
    daemon.call("GET", "/v1/health", headers={"Host": "lab.example"})


def test_sighup_of_a_closed_terminal_ends_the_daemon_with_the_gate_off(board, make_daemon):
    daemon = make_daemon(board)
    daemon.arm()
    daemon.process.send_signal(signal.SIGHUP)
    assert daemon.process.wait() == 0
    wait_for(lambda: board.of("state")[-1]["state"] == "DISARMED", "DISARMED")


# --- sandbox ----------------------------------------------------------------------------------------------------


@pytest.mark.skipif(find_obstacle() is not None, reason=str(find_obstacle()))
def test_the_daemon_works_in_the_sandbox(board, tmp_path, monkeypatch):
    """The sandbox has the unit's system calls, no capabilities and a read-only file system."""
    state = tmp_path / "state"
    state.mkdir()
    monkeypatch.setattr("rig.OPTODRIVE", build_sandboxed(tmp_path, writable=state))
    monkeypatch.setenv("XDG_CACHE_HOME", str(state))
    kernels = code_folder()
    if kernels is not None:  # otherwise they would be compiled in the sandbox, which takes a minute
        shutil.copytree(kernels, state / "optodrive" / "kernels")
    (state / "tokens.toml").write_text(HEAD + ENTRY.format("rig", TOKEN))
    (state / "tokens.toml").chmod(0o600)
    text = f'socket = "{state}/s"\ntokens = "{state}/tokens.toml"\naudit = "{state}/audit.jsonl"'
    replace = [("lease_s = 1.0", f"lease_s = 1.0\n[daemon]\n{text}\n#")]
    daemon = Daemon(tmp_path, board.port, replace=replace, runtime=state)
    try:
        status = innermost_status(daemon.process.pid)
        assert (status["Seccomp"], status["NoNewPrivs"]) == ("2", "1")
        assert int(status["CapEff"], 16) == int(status["CapPrm"], 16) == 0
        daemon.arm()
        plan = daemon.call("POST", "/v1/plans", json=long_train(seconds=0.5))["plan"]
        assert daemon.finished(plan)["status"] == "done"
        daemon.call("POST", "/v1/stop")
        events = [json.loads(line)["event"] for line in (state / "audit.jsonl").read_text().splitlines()]
        assert events[:2] == ["started", "requested"]
    finally:
        daemon.stop()


@pytest.mark.skipif(find_obstacle() is not None, reason=str(find_obstacle()))
def test_the_test_fails_without_the_sandbox(tmp_path, monkeypatch):
    """The same accesses succeed outside the sandbox and fail inside."""
    state = tmp_path / "state"
    state.mkdir()
    monkeypatch.setattr("sandbox.OPTODRIVE", sys.executable)
    inside = build_sandboxed(tmp_path, writable=state)
    tries = {
        "a file of the system": f"open({str(tmp_path / 'elsewhere')!r}, 'w')",
        "a call that the unit does not allow": "import os; os.sched_setaffinity(0, os.sched_getaffinity(0))",
        "another user": "import os; os.setuid(1234)",
    }
    for what, code in tries.items():
        done = subprocess.run([inside, "-c", code], capture_output=True, text=True)
        assert done.returncode == 1, what
        assert "Error" in done.stderr, what
    assert subprocess.run([inside, "-c", f"open({str(state / 'x')!r}, 'w').write('y')"]).returncode == 0


@pytest.mark.skipif(find_obstacle() is not None, reason=str(find_obstacle()))
def test_the_sandbox_permits_real_time_scheduling_and_a_lower_priority(tmp_path, monkeypatch):
    """The call is tried with the ordinary policy, because the machine of the tests may not grant another."""
    state = tmp_path / "state"
    state.mkdir()
    monkeypatch.setattr("sandbox.OPTODRIVE", sys.executable)
    inside = build_sandboxed(tmp_path, writable=state)
    code = "import os; os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0)); os.nice(5); print(os.nice(0))"
    done = subprocess.run([inside, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, f"{min(19, os.nice(0) + 5)}\n"), done.stderr


def innermost_status(pid):
    """Return /proc/PID/status of the daemon, a descendant of bubblewrap."""
    while children := Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        pid = int(children[0])
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return dict(line.split(":\t", 1) for line in lines if ":\t" in line)


DAMAGED = {
    "a pipe": os.mkfifo,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a larger file": lambda path: path.write_bytes(b"#" * 1_000_001),
    "an integer of more digits": lambda path: path.write_text(f"version = {'1' * 5000}"),
    "deeper nesting": lambda path: path.write_text(f"version = {'[' * 5000}"),
    "line 1": lambda path: path.write_text(f"{'.'.join('a' * 30_000)} = 1"),
}


@pytest.mark.parametrize("is_armed", [True, False])
def test_sighup_with_a_damaged_file_changes_nothing_and_ends_nothing(manager, board, make_daemon, tmp_path, is_armed):
    """Every kind of file in place of the tokens, and of the configuration: one line, and the audit says so."""
    kept, audit = tmp_path / "kept.toml", tmp_path / "audit.jsonl"
    sound = HEAD + ENTRY.format("rig", TOKEN) + ENTRY.format("ben", "another-token-for-ben")
    kept.write_text(sound)
    kept.chmod(0o600)
    daemon = make_daemon(
        board, replace=[("lease_s = 1.0", f'lease_s = 1.0\n[daemon]\ntokens = "{kept}"\naudit = "{audit}"\n#')]
    )
    if is_armed:
        daemon.arm()
    refusals = 0
    for path in (kept,) if is_armed else (kept, daemon.config):
        content = path.read_text()
        for naming, damage in DAMAGED.items():
            path.unlink()
            damage(path)
            if path.is_file():
                path.chmod(0o600)
            lines, ready = daemon.errors.read_text(), manager.listen().count("READY=1")
            daemon.process.send_signal(signal.SIGHUP)
            wait_for(lambda ready=ready: manager.listen().count("READY=1") > ready, "the end of the reload")
            (said,) = daemon.errors.read_text().removeprefix(lines).splitlines()
            assert said.startswith(f"optodrive: not reloaded, nothing changed: {path}")
            assert naming in said
            refusals += 1
            path.unlink()
            path.write_text(content)
            path.chmod(0o600)
    assert daemon.board_state() == ("ARMED" if is_armed else "DISARMED")
    ben = {"Authorization": "Bearer another-token-for-ben"}
    daemon.call("GET", "/v1/state", headers=ben)
    kept.write_text(HEAD + ENTRY.format("rig", TOKEN))
    assert "tokens revoked: ben" in reload(daemon, manager, lambda text: text)
    daemon.call("GET", "/v1/state", status=401, headers=ben)
    wait_for(lambda: audit.read_text().count('"reload_refused"') == refusals, "the audit")
