"""Diagnosis of many pixels on processes that may die, with narrative, answer and map."""

import json
import os
import signal
from functools import partial
from multiprocessing import active_children

import numpy as np
import pytest

from display_lab import display_lab
from optodrive.cli.main import run
from optodrive.core.errors import InputError
from optodrive.core.types.measurements import Measurement, Run, Signal
from optodrive.device.config_file import load_config
from optodrive.lab.diagnosis.display_diagnosis import (
    DisplayAnswer,
    PixelTask,
    compile_kernels,
    diagnose_pixel,
    run_tasks,
)
from optodrive.lab.diagnosis.display_report import (
    build_display_answer,
    build_display_narrative,
    build_display_report,
    format_ranges,
)
from optodrive.lab.recording import DisplayRuns, read_recording, write_recording

DROOP = {"laser_droop": {"share": 0.15, "time": 0.05, "spread": 1.0}}
HIDDEN = {pixel: DROOP if pixel % 4 == 1 else {} for pixel in range(20, 26)}
QUICK = {"groups": ("weak", "middle", "strong"), "repeats": 2, "rate": 500.0}
BAD = 31
KILLER = 99


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Return a recording of six valid pixels, one pixel with an invalid time axis, and mirrors in one run."""
    path = tmp_path_factory.mktemp("display") / "display.h5"
    write_recording(path, Measurement((*display_lab(HIDDEN, **QUICK).runs, one_sample_run(), mirror_run())))
    spoil(path)
    return path


def one_sample_run():
    t_s = np.linspace(0.0, 0.1, 20)
    pulses = np.array([[0.02, 0.01, 1.0, float(BAD)]])
    return Run("pixel31-run", 293.15, pulses, {"displacement_m": Signal(BAD, t_s, np.linspace(0.0, 1e-5, 20))})


def mirror_run():
    t_s = (np.arange(400) + 0.5) * 2e-4
    moves = np.array([[0.0, 0.0, 0.0], [0.02, 0.01, 0.0], [0.04, -0.02, 0.0]])
    followed = moves[np.searchsorted(moves[:, 0], t_s, side="right") - 1, 1]
    noisy = followed + 1e-5 * np.random.default_rng(1).standard_normal(len(t_s))
    return Run("turning", 293.15, np.zeros((0, 4)), {"mirror_x_rad": Signal(0, t_s, noisy)}, {}, moves)


def spoil(path):
    """Make a time axis decrease, which only reading the samples reveals."""
    import h5py

    with h5py.File(path, "r+") as file:
        file["runs/pixel31-run/displacement_m/t_s"][7] = 0.0


def tasks_of(runs):
    return [PixelTask(item.pixel, item.read) for item in runs.pixels]


@pytest.fixture(scope="module")
def answers_by_pixel(recording):
    """Diagnose all pixels in this process."""
    return {task.pixel: diagnose_pixel(task) for task in tasks_of(DisplayRuns.open([recording]))}


def run_with_killer(tasks, workers):
    """Yield the pixel, answer and error of each task, and of one that kills its worker each time."""
    killer = PixelTask(KILLER, partial(signal.raise_signal, signal.SIGKILL))
    for task, answer, error in run_tasks(diagnose_pixel, [*tasks, killer], workers):
        yield task.pixel, answer, error


def check_is_alike(remote, local):
    assert remote.discrepancy.parameters == local.discrepancy.parameters
    assert remote.discrepancy.candidates == local.discrepancy.candidates
    assert remote.discrepancy.gain == local.discrepancy.gain


def check_is_reported(answer, error):
    assert answer is None
    assert "worker died" in error


@pytest.mark.slow
def test_every_pixel_has_an_answer_although_workers_were_killed(answers_by_pixel, recording):
    """Two processes, one of which is killed, beside the task that kills its worker."""
    compile_kernels()
    answers = {}
    for pixel, answer, error in run_with_killer(tasks_of(DisplayRuns.open([recording])), workers=2):
        if not answers:
            os.kill(min(child.pid for child in active_children()), signal.SIGKILL)
        answers[pixel] = (answer, error)
    assert sorted(answers) == [*HIDDEN, BAD, KILLER]
    check_is_reported(*answers[KILLER])
    for pixel, terms in HIDDEN.items():
        answer, error = answers[pixel]
        assert not error
        assert answer.discrepancy.causes == tuple(terms)
        check_is_alike(answer, answers_by_pixel[pixel])


def test_a_pixel_that_kills_its_workers_is_reported_and_affects_no_other(answers_by_pixel, recording):
    compile_kernels()
    tasks = tasks_of(DisplayRuns.open([recording]))[:2]
    answers = {pixel: own for pixel, *own in run_with_killer(tasks, workers=1)}
    assert sorted(answers) == [*list(HIDDEN)[:2], KILLER]
    check_is_reported(*answers.pop(KILLER))
    for pixel, (answer, error) in answers.items():
        assert not error
        check_is_alike(answer, answers_by_pixel[pixel])


def test_bad_data_are_that_pixels_error_alone(answers_by_pixel):
    answer = answers_by_pixel[BAD]
    assert answer.discrepancy is None
    assert "pixel31-run/displacement_m/t_s[7]" in answer.error
    assert "\n" not in answer.error


def test_narrative_and_answer_of_a_display(answers_by_pixel):
    found = DisplayAnswer(tuple(answers_by_pixel.values()), None, 1.0)
    lines = build_display_narrative(found)
    assert lines[0].startswith("Of 7 pixels, each diagnosed separately, 2 show an error of the nominal model")
    assert any("2 pixels: the laser's power falls while it is on (laser_droop): 21, 25." in line for line in lines)
    assert any(line.startswith("  laser_droop.share: median 0.") for line in lines)
    assert lines[-1] == "Model of the display: medians over 4 of 7 pixels."
    document = json.loads(json.dumps(build_display_answer(found)))
    verdicts = document["summary"]["verdicts"]
    assert verdicts["none"] + verdicts["undecided"] == 4
    assert {name: count for name, count in verdicts.items() if count} == {
        "cause": 2,
        **{name: verdicts[name] for name in ("none", "undecided") if verdicts[name]},
    }
    assert document["summary"]["errors"] == [BAD]
    assert document["pixels"]["21"]["causes"] == ["laser_droop"]
    low, high = document["pixels"]["21"]["parameters"]["laser_droop.share"]["ci95"]
    assert low < 0.15 < high
    assert document["pixels"]["31"]["verdict"] is None


def test_the_map_follows_the_layout_and_is_self_contained(answers_by_pixel):
    found = DisplayAnswer(tuple(answers_by_pixel.values()), None, 1.0)
    html = build_display_report(found, "display.h5", load_config("display-437"))
    assert html.count("<title>pixel ") == 437
    assert "<title>pixel 21: the laser&#x27;s power falls while it is on (laser_droop); laser_droop.share 0." in html
    assert "pixel 0: not measured" in html
    for word in ("<script", "http", "url("):
        assert word not in html
    small = build_display_report(found, "display.h5", load_config("display-16"))
    assert small.count("<title>pixel ") == 7
    assert "; display-16 has no pixel 31." in small


@pytest.mark.slow
def test_the_command_writes_report_answer_and_model(tmp_path, capsys):
    path, out = tmp_path / "five.h5", tmp_path / "answer"
    few = display_lab(dict.fromkeys((3, 4, 5), DROOP) | {6: {}}, **QUICK)
    write_recording(path, Measurement((*few.runs, one_sample_run(), mirror_run())))
    assert run(["diagnose", str(path), "--workers", "2", "--out", str(out), "--json", "-"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert sorted(document["pixels"], key=int) == ["3", "4", "5", "6", "31"]
    assert document["mirrors"]["verdict"] in ("none", "unexplained", "cause", "ambiguous")
    assert json.loads((out / "diagnosis.json").read_text()) == document
    assert "<h2>Map</h2>" in (out / "report.html").read_text()
    assert (out / "model.toml").exists() == document["summary"]["model"]["written"]


@pytest.mark.parametrize(
    "address", ["nonsense", "tcp://127.0.0.1", "http://127.0.0.1:8786", "tls://127.0.0.1:9", "tcp://127.0.0.1:9"]
)
def test_an_address_where_no_scheduler_is(address, recording, tmp_path, capsys):
    out = tmp_path / "answer"
    assert run(["diagnose", str(recording), "--dask", address, "--out", str(out)]) == 2
    error = capsys.readouterr().err.strip()
    assert "--dask" in error
    assert address in error
    assert "\n" not in error
    assert not out.exists()


def test_a_cluster_has_its_own_workers(recording, capsys):
    assert run(["diagnose", str(recording), "--dask", "tcp://127.0.0.1:9", "--workers", "2"]) == 2
    assert "--workers" in capsys.readouterr().err


@pytest.mark.parametrize("more", [["--live"], []], ids=["live", "whole display"])
def test_a_discovery_where_there_is_none_is_refused(recording, tmp_path, more, capsys):
    given = more or [str(recording), "--out", str(tmp_path / "answer")]
    assert run(["diagnose", "--discover", *given]) == 2
    (error,) = capsys.readouterr().err.strip().splitlines()
    assert "--discover" in error
    assert list(tmp_path.iterdir()) == []


def test_a_pixel_reads_its_own_runs_and_signals(recording):
    runs = DisplayRuns.open([recording])
    assert [item.pixel for item in runs.pixels] == [*HIDDEN, BAD]
    own = runs.pixels[3].read()
    whole = read_recording_of(recording, runs.pixels[3].parts[0].names)
    assert [item.name for item in own.runs] == [item.name for item in whole]
    assert all(signal.pixel == 23 for item in own.runs for signal in item.signals.values())
    assert [item.name for item in runs.mirrors.read().runs] == ["turning"]


def read_recording_of(path, names):
    from optodrive.lab.recording import read_runs

    return read_runs(path, list(names)).runs


def test_a_file_that_changes_meanwhile_is_refused(tmp_path):
    path = tmp_path / "display.h5"
    write_recording(path, display_lab({3: {}}, groups=("weak",), repeats=2))
    task = tasks_of(DisplayRuns.open([path]))[0]
    write_recording(path, display_lab({3: {}}, groups=("weak", "strong"), repeats=2))
    assert "when the diagnosis began" in diagnose_pixel(task).error
    with pytest.raises(InputError, match="when the diagnosis began"):
        task.read()


def test_folders_are_read_by_pixel_too(tmp_path):
    measurement = display_lab({3: {}, 8: {}}, groups=("weak",), repeats=2)
    write_recording(tmp_path / "one", measurement)
    write_recording(tmp_path / "two.h5", measurement)
    runs = DisplayRuns.open([tmp_path / "one", tmp_path / "two.h5"])
    names = [item.name for item in runs.pixels[1].read().runs]
    assert names == ["one/pixel8-run000", "one/pixel8-run001", "two/pixel8-run000", "two/pixel8-run001"]
    values = [item.signals["displacement_m"].value for item in read_recording(tmp_path / "two.h5").runs[2:]]
    for item, value in zip(runs.pixels[1].read().runs, [*values, *values], strict=True):
        np.testing.assert_array_equal(item.signals["displacement_m"].value, value)


def test_pixels_in_words():
    assert format_ranges([3, 7, 8, 12, 13, 14, 15]) == "3, 7, 8, 12 to 15"
    assert format_ranges([4]) == "4"
