"""`optodrive serve --record-session`: the file compared with the daemon's responses and the board's log."""

import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from forked_process import run_process
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording import read_recording, write_recording
from optodrive.lab.recording.trials import CLOCKS, read_trials
from rig import long_train, wait_for

LABELS = {"subject": "S07 µ", "trial": 12, "practice": False}
OPTODRIVE = Path(sys.executable).with_name("optodrive")


def list_descendants(pid):
    threads = Path(f"/proc/{pid}/task").iterdir()  # the recorder may have been started by any thread
    children = [int(child) for thread in threads for child in (thread / "children").read_text().split()]
    return children + [found for child in children for found in list_descendants(child)]


def writer_of(daemon):
    processes = list_descendants(daemon.process.pid)
    found = [pid for pid in processes if b"session_writer" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    assert len(found) == 1
    return found[0]


def test_request_plan_execution_and_simulation_are_recorded_and_merged(board, make_daemon, tmp_path):
    path = tmp_path / "session.h5"
    daemon = make_daemon(board, options=("--record-session", str(path)))
    daemon.arm()
    frames = {"frames": [{"show_at_s": 0, "duration_s": 1, "target_um": {"17": 90, "18": 60}}]}
    requests = (("plans", frames | {"labels": LABELS}), ("patterns/pixel", {"pixel": 17, "labels": LABELS}))
    answers = [daemon.finished(daemon.call("POST", f"/v1/{path}", json=body)["plan"]) for path, body in requests]
    assert [answer["labels"] for answer in answers] == [LABELS, LABELS]
    daemon.call("POST", "/v1/plans", json=long_train())
    wait_for(lambda: len(board.of("pulse")) > 15, "pulses")
    daemon.call("POST", "/v1/stop")
    stopped = daemon.finished("p3")
    daemon.stop()
    assert "recording" not in daemon.errors.read_text()
    with h5py.File(path) as file:
        runs, plans = file["runs"], file["plans"]
        assert [plans[f"p{k}"].attrs["status"] for k in (1, 2, 3)] == ["done", "done", "stopped"]
        np.testing.assert_allclose(plans["p1/target_um"][0, [17, 18]], [90, 60])
        assert [json.loads(plans[f"p{k}/labels"][()]) for k in (1, 2, 3)] == [LABELS, LABELS, {}]
        parameters = [json.loads(plans[f"p{k}/parameters"][()]) for k in (1, 2, 3)]
        assert parameters == [{}, {"pixel": 17, "height_um": 100.0, "intensity": None, "seconds": 1.0}, {}]
        for answer in answers:
            kept, columns = plans[answer["plan"]], answer["executed_pulses"]
            np.testing.assert_allclose(1e6 * kept["simulated_m"][:], columns["simulated_um"])
            np.testing.assert_allclose(kept["executed"][:, 1], columns["width_s"])
            assert kept["executed"][:, 3].tolist() == columns["pixel"]
            np.testing.assert_allclose(kept["planned"][:, 0], answer["pulses"]["start_s"])
        assert len(plans["p3/executed"]) == len(plans["p3/simulated_m"]) == stopped["executed"]
        run = plans["p1"].attrs["run"]
        pulses = runs[run]["pulses"][:]
        count = sum(len(runs[name]["pulses"]) for name in runs)
        assert count == sum(answer["executed"] for answer in (*answers, stopped))
    trials = read_trials(path)
    assert [(trial.status, trial.labels) for trial in trials] == [("done", LABELS), ("done", LABELS), ("stopped", {})]
    for trial, answer in zip(trials, (*answers, stopped), strict=True):
        assert trial.executed == {name: answer["onset"][name] for name in CLOCKS}
        assert trial.planned_pulses == answer["planned"]
        late_s = {name: trial.executed[name] - trial.requested[name] for name in CLOCKS}
        assert late_s["monotonic_s"] == pytest.approx(late_s["board_s"], abs=1e-6)
        assert late_s["unix_s"] == pytest.approx(late_s["board_s"], abs=1e-6)
        assert late_s["board_s"] == pytest.approx(answer["pulses"]["start_s"][0] if answer["pulses"] else 0.0, abs=0.01)
    lab = tmp_path / "lab"
    t_s = np.linspace(0, 1, 40)
    signal = Signal(17, t_s, 1e-6 * t_s, 1e-7)
    write_recording(lab, Measurement((Run(run, 293.0, np.zeros((0, 4)), {"displacement_m": signal}, {}),)))
    merge = [OPTODRIVE, "recording", "merge", path, lab, "--out", tmp_path / "both.h5"]
    run_process(merge, check=True)
    np.testing.assert_array_equal(read_recording(tmp_path / "both.h5").runs[0].pulses, pulses)


@pytest.mark.slow
def test_a_full_disk_ends_the_recording_and_not_the_display(board, make_daemon, tmp_path):
    folder = tmp_path / "sessions"
    folder.mkdir()
    record = f'[daemon]\nrecord = "{folder}"\n\n[board]'
    daemon = make_daemon(board, replace=(("[board]", record),))
    (path,) = folder.iterdir()
    limit = path.stat().st_size
    subprocess.run(["/usr/bin/prlimit", f"--fsize={limit}", "--pid", str(writer_of(daemon))], check=True)
    daemon.arm()
    plan = daemon.call("POST", "/v1/plans", json=long_train(seconds=3.0))["plan"]
    assert daemon.finished(plan)["status"] == "done"
    wait_for(lambda: "stopped" in daemon.errors.read_text(), "the line")
    assert daemon.finished(daemon.call("POST", "/v1/plans", json=long_train(seconds=0.5))["plan"])["status"] == "done"
    assert daemon.state()["board"]["underruns"] == 0
    assert daemon.call("POST", "/v1/stop")["board"]["state"] == "DISARMED"
    assert board.of("gate")[-1]["on"] is False
    daemon.stop()
    errors = daemon.errors.read_text()
    assert errors.count("recording to") == errors.count("the display goes on") == 1
    with h5py.File(path) as file:
        assert list(file["plans"]) == ["config"]


def test_an_existing_file_is_rejected_at_startup(board, make_daemon, tmp_path):
    (tmp_path / "taken.h5").write_text("dear")
    with pytest.raises(AssertionError, match="this one exists"):
        make_daemon(board, options=("--record-session", str(tmp_path / "taken.h5")))
