"""`optodrive serve` on laser DACs: emulated network devices in real time, and processes that are killed."""

import os
import random
import signal
import time
from pathlib import Path

import pytest

from dac.bench import build_train, record_cold
from dac.device_process import DeviceProcess, serve_ether_dream, serve_idn
from dac.sample_log import dark_from_s
from optodrive.device.config_file import load_config
from optodrive.link.dac.formats.ether_dream import BROADCAST_PORT
from optodrive.link.dac.formats.registry import FORMATS
from optodrive.planning import heat_record
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.stimuli.sequence_file import sequence_to_json
from rig import Daemon, config_text, read_proc, wait_for

SERVES = {"ether_dream": serve_ether_dream, "idn": serve_idn}
IDENTITIES = {"ether_dream": "00:04:a3:01:02:03", "idn": "01020304050607"}
NOTICE_S = 0.15
"""Until the board has noticed that its host is dead: one lease, and the stop's way to the device."""
TRAIN = sequence_to_json(build_train(width_s=0.02, gap_s=0.01, power_w=0.3, duration_s=1.5))


@pytest.fixture(autouse=True)
def heat_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HEAT_FOLDER", str(tmp_path / "heat"))
    monkeypatch.setattr(heat_record, "FOLDER", tmp_path / "heat")


def start_device(folder, transport):
    return DeviceProcess(SERVES[transport], folder, BROADCAST_PORT if transport == "ether_dream" else 0)


def start_daemon(folder, transport, device):
    lines = f'transport = "{transport}"\nport = "{device.address}"\ninterlock_watched = true\n'
    replace = [('transport = "simulated"', lines), ("[scanner]", "[scanner]\nhalf_range_codes = 2047")]
    text = config_text(None, "display-16", lease_s=0.1)
    for old, new in replace:
        text = text.replace(old, new)
    (folder / "display.toml").write_text(text)
    record_cold(DisplayModel.from_config(load_config(str(folder / "display.toml"))), transport, IDENTITIES[transport])
    return Daemon(folder, None, name="display-16", replace=replace, lease_s=0.1)


def find_board(daemon):
    """Return the process id of the DAC's board."""
    link = daemon.find_process("link")
    for task in Path(f"/proc/{link}/task").iterdir():  # a child belongs to the thread that started it
        for child in read_proc(link, f"task/{task.name}/children").split():
            if "dac_process" in read_proc(child, "cmdline"):
                return int(child)
    return None


def begin(daemon):
    """Arm and push a train, and wait until it plays."""
    if daemon.board_state() == "DISARMED":
        daemon.arm()
    wait_for(lambda: daemon.board_state() == "ARMED", "the board to be armed")
    plan = daemon.call("POST", "/v1/plans", json=TRAIN)["plan"]
    wait_for(lambda: daemon.board_state() in ("RUNNING", "HOLD"), "the plan to begin")
    return plan


def check_death(folder, transport, seed):
    """Kill the link process, the whole daemon or the DAC's board at a random moment. Return when it was dark, s."""
    folder.mkdir()
    device = start_device(folder, transport)
    daemon = start_daemon(folder, transport, device)
    try:
        begin(daemon)
        time.sleep(random.Random(seed).uniform(0.0, 1.4))
        victims = {
            "board": [find_board(daemon)],
            "link": [daemon.find_process("link")],
            "daemon": [daemon.process.pid, *daemon.list_children()],
        }
        kind = ("board", "link", "daemon")[seed % 3]
        for pid in victims[kind]:
            os.kill(pid, signal.SIGKILL)
        device.mark()
        time.sleep(0.5)
    finally:
        daemon.stop()
        log = device.finish()
    dark_s = dark_from_s(log["table"])
    assert dark_s > 0.0
    assert log["table"][-1, 5] == 0.0
    bound_s = FORMATS[transport].host_loss_max_s + (0.0 if kind == "board" else NOTICE_S)
    assert dark_s <= log["marks_s"][0] + bound_s
    return dark_s


@pytest.mark.slow
@pytest.mark.timeout(0)
@pytest.mark.parametrize("transport", SERVES)
def test_a_death_at_twenty_five_moments_is_dark_within_the_devices_bound(tmp_path, transport):
    for seed in range(25):
        check_death(tmp_path / str(seed), transport, seed)


@pytest.mark.slow
@pytest.mark.timeout(0)
@pytest.mark.parametrize("transport", SERVES)
def test_a_daemon_plays_pauses_and_stops_a_laser_dac(tmp_path, transport):
    device = start_device(tmp_path, transport)
    daemon = start_daemon(tmp_path, transport, device)
    try:
        assert "Laser DAC: no interlock" in daemon.state()["link"]["limitation"]
        plan = begin(daemon)
        daemon.call("POST", "/v1/pause")
        time.sleep(0.3)
        device.mark()
        time.sleep(0.3)
        device.mark()
        daemon.call("POST", "/v1/resume")
        assert daemon.finished(plan)["status"] == "done"
        begin(daemon)
        time.sleep(0.3)
        daemon.call("POST", "/v1/stop")
        device.mark()
        time.sleep(0.4)
    finally:
        daemon.stop()
        log = device.finish()
    light = log["table"][log["table"][:, 5] > 0]
    from_s, (paused_s, resumed_s, stopped_s) = light[:, 0], log["marks_s"]
    assert not ((from_s > paused_s) & (from_s < resumed_s)).any()
    assert (from_s > resumed_s).any()
    rest_s = 0.0 if FORMATS[transport].stops_at_once else FORMATS[transport].host_loss_max_s
    assert light[-1, 1] <= stopped_s + rest_s
