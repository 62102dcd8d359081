"""The service under a running systemd, with a simulated board."""

import json
import shutil
import subprocess
import sys

import pytest

from optodrive.core.kernels import code_folder
from optodrive.device.config_file import locate_shipped
from rig import config_text
from systemd_machine import ENVIRONMENT, PROGRAM, PYTHON, find_obstacle, machine_files, run_script

DROP_IN = f"""[Service]
# The simulated board is a pseudo-terminal.
DeviceAllow=/dev/ptmx rw
DeviceAllow=char-pts rw
{ENVIRONMENT}
"""
SCRIPT = f"""
say() {{ echo "$1=$(echo $2)"; }}
show() {{ systemctl show optodrive --property "$1" --value; }}
board() {{ OPTODRIVE_TOKENS=/var/lib/optodrive/tokens.toml {PROGRAM} status --json |
    sed -n 's/.*"state": *"\\(DISARMED\\|ARMED\\|FAULT\\)".*/\\1/p' | head -1; }}
has_restarted() {{ [ "$(show MainPID)" != "$1" ] && [ "$(show ActiveState)" = active ]; }}
await_restart() {{ for i in $(seq 300); do has_restarted "$1" && return; sleep 0.1; done; }}
systemd-sysusers optodrive.conf
chown -R optodrive: /var/cache/optodrive
systemctl daemon-reload
systemctl start optodrive
say started $?
if [ "$(show ActiveState)" != active ]; then journalctl --no-pager >&2; exit 1; fi
say active "$(show ActiveState)"
say user "$(ps -o user= -p $(show MainPID))"
say socket "$(stat -c '%U:%G %a' /run/optodrive/optodrive.sock)"
say descriptors "$(show LimitNOFILE)"
say board "$(board)"
systemctl reload optodrive
say reloaded $?
main=$(show MainPID)
kill -9 $(pgrep -P $main opto-planner)
for i in $(seq 100); do grep -q restarted /var/lib/optodrive/audit.jsonl && break; sleep 0.1; done
say replaced "$(grep -o '"process": "[a-z]*"' /var/lib/optodrive/audit.jsonl)"
say same_supervisor "$([ $main = $(show MainPID) ]; echo $?)"
sed -i 's/^damping =/dampin =/' /etc/optodrive/config.toml
systemctl reload optodrive
say reloaded_wrong $?
say active_after_wrong "$(show ActiveState)"
sed -i 's/^dampin =/damping =/' /etc/optodrive/config.toml
first=$(show MainPID)
kill -9 $first
await_restart $first
say restarts "$(show NRestarts)"
say board_after_kill "$(board)"
systemctl stop optodrive
say stopped "$(show ActiveState) $(show Result)"
journalctl -u optodrive -o cat --no-pager >&2
"""


UID = "0123456789abcdef01234567"
RECORD = f"/var/tmp/optodrive-heat/board-{UID}"
HEAT_SCRIPT = f"""
export OPTODRIVE_TOKENS=/var/lib/optodrive/tokens.toml
say() {{ echo "$1=$2"; }}
reason() {{ {PROGRAM} status --json | sed -n 's/.*"hot_reason": *"\\([^"]*\\)".*/\\1/p'; }}
arm() {{ for i in $(seq 10); do {PROGRAM} arm >/dev/null 2>&1 && return; sleep 0.2; done; {PROGRAM} arm >&2; }}
main() {{ systemctl show optodrive --property MainPID --value; }}
mkdir /run/board
printf 'uid = "{UID}"\\nlease_ms = 1000\\n' > /run/board/limits.toml
{ENVIRONMENT.removeprefix("Environment=")} {PYTHON} -m optodrive.link.simulator.board_process --pty /run/board/tty \
    --log /run/board/log --limits /run/board/limits.toml &
for i in $(seq 100); do [ -e /run/board/tty ] && break; sleep 0.1; done
chmod 666 "$(readlink /run/board/tty)"
systemd-sysusers optodrive.conf
chown -R optodrive: /var/cache/optodrive
systemctl daemon-reload
systemctl start optodrive
arm
say first "$(reason)"
say folder "$(stat -c '%U %a' /var/tmp/optodrive-heat)"
say record "$(stat -c '%U %a' {RECORD})"
systemctl stop optodrive
systemctl start optodrive
arm
say stopped "$(reason)"
was=$(main)
systemctl kill --signal=STOP optodrive
systemctl kill --signal=KILL optodrive
for i in $(seq 300); do [ "$(main)" != 0 ] && [ "$(main)" != "$was" ] && break; sleep 0.1; done
{PROGRAM} disarm >/dev/null
arm
say killed "$(reason)"
systemctl stop optodrive
journalctl -u optodrive -o cat --no-pager >&2
"""


def install_service(folder, root, text):
    """Install the service of a configuration, with the kernels that this machine has compiled."""
    config = folder / "mine.toml"
    config.write_text(text)
    command = [sys.executable, "-m", "optodrive.cli.main", "service", "install", "--program", PROGRAM]
    subprocess.run([*command, "--root", root, "--config", config], check=True, capture_output=True)
    drop_in = root / "etc/systemd/system/optodrive.service.d/board.conf"
    drop_in.parent.mkdir()
    drop_in.write_text(DROP_IN)
    kernels = code_folder()
    if kernels is not None:  # otherwise they would be compiled there, which takes a minute
        shutil.copytree(kernels, root / "var/cache/optodrive/optodrive/kernels")


@pytest.mark.slow
@pytest.mark.skipif(find_obstacle() is not None, reason=str(find_obstacle()))
def test_the_heat_of_the_display_outlives_the_service(tmp_path):
    """Its record is the machine's, it is written by the service's user, and its run of the computer is known."""
    with machine_files(tmp_path) as root:
        install_service(tmp_path, root, config_text("/run/board/tty", "display-16"))
        shutil.rmtree(root / "var/tmp/optodrive-heat", ignore_errors=True)
        results, errors = run_script(root, HEAT_SCRIPT)
    said = dict(line.split("=", 1) for line in results.splitlines())
    assert said == {
        "first": "this machine had no record of its heat",
        "folder": "root 1777",
        "record": "optodrive 666",
        "stopped": "this machine had no record of its heat",
        "killed": "the process that used it last was killed",
    }, json.dumps(said) + errors
    assert "counts as still warm, because this machine had no record" in errors


@pytest.mark.slow
@pytest.mark.skipif(find_obstacle() is not None, reason=str(find_obstacle()))
def test_the_service_starts_reloads_restarts_and_stops(tmp_path):
    with machine_files(tmp_path) as root:
        install_service(tmp_path, root, locate_shipped("display-437.toml").read_text())
        results, errors = run_script(root, SCRIPT)
    said = dict(line.split("=", 1) for line in results.splitlines())
    assert said == {
        "started": "0",
        "active": "active",
        "user": "optodrive",
        "socket": "optodrive:optodrive 660",
        "descriptors": "16384",
        "board": "DISARMED",
        "reloaded": "0",
        "replaced": '"process": "planner"',
        "same_supervisor": "0",
        "reloaded_wrong": "1",
        "active_after_wrong": "active",
        "restarts": "1",
        "board_after_kill": "DISARMED",
        "stopped": "inactive success",
    }, json.dumps(said) + errors
    assert "dampin" in errors
