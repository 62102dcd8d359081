"""The file of a session and its writer process, without a board."""

import csv
import json
import os
import resource
import signal
import time

import h5py
import numpy as np
import pytest

from optodrive.cli.main import run
from optodrive.core.errors import InputError
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.lab.recording import read_recording, write_recording
from optodrive.lab.recording.reader import merge_session
from optodrive.lab.recording.session import COLD_AFTER_S, QUEUE_MAX, SessionRecorder

ABOUT = {"display": "d", "optodrive": "0", "ambient_K": 293.15, "bridge_width_m": 4e-4, "config": "{}"}


def note(plan, start_s, pulses=3, padding=0):
    about = {"plan": plan, "name": "n", "status": "done", "error": None, "summary": "{}", "trains": "[]"}
    about |= {"first_pulse_unix_s": 1e9 + start_s, "first_pulse_at": "2001-09-09T01:46:40+00:00"}
    begin_s = start_s + 0.02 * np.arange(pulses)
    columns = [begin_s, np.full(pulses, 0.01), np.full(pulses, 2.0), np.full(pulses, 17.0)]
    executed = np.column_stack(columns)
    random = np.random.default_rng(1).random(padding)
    planned = np.column_stack([executed, np.zeros(pulses)])
    return about, {"executed": executed, "planned": planned, "simulated_m": np.full(pulses, 1e-5), "padding": random}


def recorded(path, notes, said):
    recorder = SessionRecorder(path, ABOUT, said.append)
    for each in notes:
        recorder.record(lambda each=each: each)
    recorder.close()
    return recorder


def until(condition):
    while not condition():
        time.sleep(0.01)


def test_plans_are_kept_and_a_rest_begins_a_new_run(tmp_path):
    path, said = tmp_path / "a.h5", []
    after = 1.0 + COLD_AFTER_S + 0.1
    empty = ({**note("p3", 0.0)[0], "status": "cancelled", "error": "why"}, {"planned": np.zeros((0, 5))})
    recorded(path, [note("p1", 0.5), note("p2", 0.7), empty, note("p4", after), note("p5", 0.2)], said)
    assert said == []
    with h5py.File(path) as file:
        assert list(file["runs"]) == ["run1", "run2", "run3"]
        np.testing.assert_allclose(file["runs/run1/pulses"][:, 0], [0, 0.02, 0.04, 0.2, 0.22, 0.24], atol=1e-9)
        np.testing.assert_allclose(file["runs/run2/pulses"][:, 0], [0, 0.02, 0.04], atol=1e-9)
        assert file["runs/run1"].attrs["started_unix_s"] == 1e9 + 0.5
        assert sorted(file["plans"]) == ["config", "p1", "p2", "p3", "p4", "p5"]
        assert file["plans/p2"].attrs["run"] == "run1"
        assert file["plans/p4"].attrs["run"] == "run2"
        assert file["plans/p5"].attrs["run"] == "run3"  # the clock of the board was reset
        assert (file["plans/p3"].attrs["status"], file["plans/p3"].attrs["error"]) == ("cancelled", "why")
        assert "run" not in file["plans/p3"].attrs
        np.testing.assert_allclose(file["plans/p1/simulated_m"], 1e-5)


def test_recording_show_lists_a_session(tmp_path, capsys):
    path = tmp_path / "a.h5"
    recorder = SessionRecorder(path, ABOUT, [].append)
    recorder.record(lambda: note("p1", 0.0))
    recorder.close()
    assert run(["recording", "show", str(path)]) == 0
    output = capsys.readouterr().out
    assert "run1" in output
    assert "a session of the daemon" in output
    assert run(["recording", "show", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["runs"][0]["pulses"] == 3
    assert run(["recording", "show", str(path), "--out", str(tmp_path / "p.png")]) == 2
    assert "a session" in capsys.readouterr().err


def trial(plan, start_s, labels, status="done", error=None, **onsets):
    about, arrays = note(plan, start_s)
    parameters = json.dumps({"pixel": 17})
    return about | onsets | {
        "labels": json.dumps(labels),
        "parameters": parameters,
        "status": status,
        "error": error,
    }, arrays


ONSETS = {
    "requested_board_s": 5.0,
    "requested_monotonic_s": 105.0,
    "requested_unix_s": 1e9 + 5.0,
    "executed_board_s": 5.002,
    "executed_monotonic_s": 105.002,
    "executed_unix_s": 1e9 + 5.002,
}
HEAD = (
    "plan,name,run,status,error,requested_board_s,requested_monotonic_s,requested_unix_s,executed_board_s,"
    "executed_monotonic_s,executed_unix_s,planned_pulses,executed_pulses"
)


@pytest.fixture
def session(tmp_path):
    """Return a session of three plans, the second of which ended before its first pulse, the third without onsets."""
    path = tmp_path / "a.h5"
    second = trial("p2", 9.0, {"subject": "S07, µ"}, "cancelled", "stopped by a caller", requested_board_s=9.0)
    second[1].pop("executed")
    last = note("p10", 60.0)
    recorded(path, [trial("p1", 5.002, {"trial": 1, "practice": False}, **ONSETS), second, last], [])
    return path


def test_the_trials_of_a_session_are_a_table(session, tmp_path, capsys):
    out = tmp_path / "trials.csv"
    assert run(["recording", "trials", str(session), "--out", str(out)]) == 0
    output = capsys.readouterr().out
    assert "trial=1, practice=False" in output
    assert "2001-09-09 01:46:45.002000Z" in output
    assert "2 ms" in output
    assert "0 of 3" in output
    assert out.read_text().split("\n") == [
        f"{HEAD},label_trial,label_practice,label_subject",
        "p1,n,run1,done,,5.0,105.0,1000000005.0,5.002,105.002,1000000005.002,3,3,1,false,",
        'p2,n,,cancelled,stopped by a caller,9.0,,,,,,3,0,,,"S07, µ"',
        "p10,n,run2,done,,,,,,,,3,3,,,",
        "",
    ]


def test_what_a_caller_wrote_is_no_formula_of_a_spreadsheet(tmp_path):
    path, out = tmp_path / "a.h5", tmp_path / "trials.csv"
    written = ["=1+1", "+A1", "-A1", "@SUM(1)", "a", -1.5]
    recorded(path, [trial(f"p{k}", 1.0, {"=cmd": value}, "failed", "=2+2") for k, value in enumerate(written)], [])
    assert run(["recording", "trials", str(path), "--out", str(out)]) == 0
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["label_=cmd"] for row in rows] == ["'=1+1", "'+A1", "'-A1", "'@SUM(1)", "a", "-1.5"]
    assert {row["error"] for row in rows} == {"'=2+2"}


def test_show_lists_the_trials_too(session, capsys):
    assert run(["recording", "show", str(session)]) == 0
    output = capsys.readouterr().out
    assert "stopped by a caller" in output
    assert "subject=S07, µ" in output
    assert run(["recording", "show", str(session), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)["trials"]
    assert run(["recording", "trials", str(session), "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["trials"]
    assert shown == listed
    assert [item["plan"] for item in listed] == ["p1", "p2", "p10"]
    assert listed[0]["requested"] == {"board_s": 5.0, "monotonic_s": 105.0, "unix_s": 1e9 + 5.0}
    assert listed[1]["executed"] == {"board_s": None, "monotonic_s": None, "unix_s": None}
    assert listed[0]["parameters"] == {"pixel": 17}


def test_a_recording_without_plans_has_no_trials(tmp_path, capsys):
    measured(tmp_path / "lab", ["run1"])
    write_recording(tmp_path / "lab.h5", read_recording(tmp_path / "lab"))
    for path in (tmp_path / "lab", tmp_path / "lab.h5"):
        assert run(["recording", "trials", str(path)]) == 2
        assert "got no plans, expected the file of a session" in capsys.readouterr().err
        assert run(["recording", "show", str(path), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["trials"] == []


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda plan: plan.attrs.__setitem__("executed_unix_s", 1e300), "/plans/p1/executed_unix_s: got 1e+300"),
        (lambda plan: plan.attrs.__setitem__("requested_board_s", np.nan), "/plans/p1/requested_board_s: got nan"),
        (lambda plan: plan.attrs.__setitem__("requested_board_s", "soon"), "got 'soon', expected a time"),
        (lambda plan: plan.__setitem__("labels", "[" * 100_000), "/plans/p1/labels: got"),
        (lambda plan: plan.__setitem__("labels", '{"a": NaN}'), "/plans/p1/labels: got NaN, expected finite numbers"),
        (
            lambda plan: plan.__setitem__("labels", r'{"a": "\ud800"}'),
            "labels: got half of a surrogate pair, expected Unicode",
        ),
        (lambda plan: plan.__setitem__("labels", "[1]"), "/plans/p1/labels: got a list, expected one JSON object"),
        (lambda plan: plan.__setitem__("labels", [1.0]), "/plans/p1/labels: got entries of type float64"),
        (lambda plan: plan.__setitem__("executed", np.zeros((2, 3))), "/plans/p1/executed: got the shape (2, 3)"),
        (lambda plan: plan.__setitem__("planned", h5py.SoftLink("/runs")), "/plans/p1/planned: got a link"),
    ],
)
def test_a_spoilt_plan_is_refused_in_one_line(session, capsys, spoil, message):
    with h5py.File(session, "r+") as file:
        plan = file["plans/p1"]
        for name in ("labels", "executed", "planned"):
            del plan[name]
        spoil(plan)
    assert run(["recording", "trials", str(session)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_labels_do_not_act_on_the_terminal(tmp_path, capsys):
    recorded(tmp_path / "a.h5", [trial("p1", 5.0, {"subject": "\x1b[31mred\n"})], [])
    assert run(["recording", "trials", str(tmp_path / "a.h5")]) == 0
    output = capsys.readouterr().out
    assert "\x1b" not in output
    assert "\\x1b[31mred\\n" in output


def test_a_full_disk_is_told_in_one_line_and_what_was_written_stays(tmp_path):
    path, said = tmp_path / "a.h5", []
    recorder = SessionRecorder(path, ABOUT, said.append)
    resource.prlimit(recorder._writer.pid, resource.RLIMIT_FSIZE, (1_500_000, 1_500_000))
    for k in range(30):
        recorder.record(lambda k=k: note(f"p{k}", 0.1 * k, padding=10_000))
    until(lambda: not recorder.is_recording)
    recorder.record(lambda: pytest.fail("nothing is made for a recording that has ended"))
    recorder.close()
    assert len(said) == 1
    assert "File too large" in said[0]
    assert "the display goes on" in said[0]
    with h5py.File(path) as file:
        plans = len(file["plans"]) - 1
        assert 3 < plans < 30
        assert len(file["runs/run1/pulses"]) == 3 * plans


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_writer_that_ends_or_hangs_holds_nobody_up(tmp_path, number):
    said = []
    recorder = SessionRecorder(tmp_path / "a.h5", ABOUT, said.append)
    os.kill(recorder._writer.pid, number)
    for k in range(2 * QUEUE_MAX):
        recorder.record(lambda k=k: note(f"p{k}", 0.1 * k))
    until(lambda: said)
    recorder._writer.kill()
    until(lambda: not recorder._thread.is_alive())
    assert len(said) == 1
    assert "stopped" in said[0]


def test_its_feeder_ending_ends_the_writer_with_all_that_came(tmp_path):
    """As after kill -9 of the daemon: the pipe closes in the middle of an entry."""
    said = []
    recorder = SessionRecorder(tmp_path / "a.h5", ABOUT, said.append)
    recorder.record(lambda: note("p1", 0.0))
    until(lambda: (tmp_path / "a.h5").stat().st_size and recorder._queue.empty())
    recorder.close()
    assert recorder._writer.returncode == 0
    with h5py.File(tmp_path / "a.h5") as file:
        assert "p1" in file["plans"]


def test_a_note_that_cannot_be_made_is_told(tmp_path):
    said = []
    recorder = recorded(tmp_path / "a.h5", [], said)
    recorder = SessionRecorder(tmp_path / "b.h5", ABOUT, said.append)
    recorder.record(lambda: 1 / 0)
    until(lambda: said)
    recorder.close()
    assert "ZeroDivisionError" in said[0]


def test_nothing_is_overwritten_and_a_bad_path_is_one_line(tmp_path):
    (tmp_path / "a.h5").write_text("dear")
    with pytest.raises(InputError, match="does not exist"):
        SessionRecorder(tmp_path / "a.h5", ABOUT, print)
    with pytest.raises(InputError, match="No such file"):
        SessionRecorder(tmp_path / "no" / "a.h5", ABOUT, print)


def measured(path, names, pulses=()):
    t_s = np.linspace(0.0, 0.5, 50)
    drive = np.array(pulses, dtype=float).reshape(-1, 4)
    runs = [
        Run(name, 290.0, drive, {"displacement_m": Signal(17, t_s, np.sin(t_s), 1e-7)}, {"camera": "c"})
        for name in names
    ]
    write_recording(path, Measurement(tuple(runs)))


def test_measured_signals_join_the_runs_of_their_name(tmp_path):
    session, lab, out = tmp_path / "a.h5", tmp_path / "lab", tmp_path / "b.h5"
    recorded(session, [note("p1", 0.0), note("p2", 60.0)], [])
    measured(lab, ["run2"])
    write_recording(out, merge_session(session, lab, shift_s=0.25))
    (run,) = read_recording(out).runs
    assert (run.name, run.ambient_k, run.attributes["camera"]) == ("run2", 290.0, "c")
    assert run.attributes["sample"] == "d"
    np.testing.assert_allclose(run.pulses[:, 0], [0.0, 0.02, 0.04], atol=1e-9)
    assert run.signals["displacement_m"].t_s[0] == 0.25


def test_what_does_not_belong_together_is_refused_by_name(tmp_path):
    session = tmp_path / "a.h5"
    recorded(session, [note("p1", 0.0)], [])
    measured(tmp_path / "x", ["run7"])
    with pytest.raises(InputError, match="run7"):
        merge_session(session, tmp_path / "x")
    measured(tmp_path / "y", ["run1"], pulses=[[0.0, 0.01, 1.0, 17.0]])
    with pytest.raises(InputError, match="1 pulses, expected none"):
        merge_session(session, tmp_path / "y")
    with pytest.raises(InputError, match="without signals"):
        read_recording(session)
