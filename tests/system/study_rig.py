"""Study files for tests, and the check that a session has every trial once with its stimulus as requested."""

import json
from collections import Counter

import numpy as np

from optodrive.device.config_file import load_config
from optodrive.planning.stimuli.pattern_registry import build_pattern

SHORT = """
format = "optodrive-study"
version = 2
name = "short"
title = "Short"
seed = 3
repetitions = {repetitions}
pause_s = 0.0
{more}

[stimulus]
pattern = "experiment-6"

[factors]
digits = ["2-3", "3-4", "4-5"]

[response]
kind = "choice"
question = "Which?"
answers = ["2-3", "3-4", "4-5"]
correct_factor = "digits"
chance_level = 0.3333

[simulation]
observer = "digits"
"""
TRIALS = 9


def write_study(folder, more="", repetitions=3):
    path = folder / "short.toml"
    path.write_text(SHORT.format(more=more, repetitions=repetitions))
    return path


def read_records(path):
    """Read the whole lines of a log."""
    content = path.read_bytes() if path.exists() else b""
    return [json.loads(line) for line in content[: content.rfind(b"\n") + 1].splitlines()]


def find_defects(records):
    """Return how the records of an ended session lose, double or distort a trial; none if they do not."""
    order = records[0]["order"]
    defects = []
    counts = Counter(record["trial"] for record in records if record["record"] == "trial")
    defects += [
        f"trial {k}: {counts[k]} times" for k in range(len(order)) if counts[k] != 1 and not is_spared(order, counts, k)
    ]
    open_trial = None
    for record in records[1:]:
        kind = record["record"]
        if kind == "begun":
            if open_trial is not None:
                defects.append(f"trial {open_trial} neither ended nor marked")
            open_trial = record["trial"]
        elif kind in ("trial", "spoiled", "interrupted"):
            if record["trial"] != open_trial:
                defects.append(f"{kind} of trial {record['trial']}, not of {open_trial}")
            open_trial = None
        if kind == "trial":
            if not order[record["trial"]]["condition"].items() <= record["condition"].items():
                defects.append(f"trial {record['trial']}: another condition")
            defects += [
                f"trial {record['trial']}: another stimulus"
                for p in record["presentations"]
                if not is_as_requested(record, p)
            ]
    if open_trial is not None:
        defects.append(f"trial {open_trial} neither ended nor marked")
    return defects


def is_spared(order, counts, trial):
    """Return whether a trial is one of the last of a practice, of which the criterion spared all that follow."""
    practice = sum(each["phase"] == "practice" for each in order)
    return trial < practice and not any(counts[k] for k in range(trial, practice))


def is_as_requested(record, presentation):
    """Return whether a presentation's pulses are those of the pattern, in order, widths and times from the first."""
    requested, *others = record["requested"]
    if others or not requested["pattern"].startswith("experiment-"):
        return True  # judged by the designs' own test
    trains = build_pattern(requested["pattern"], requested["parameters"], load_config()).trains
    rows = sorted((start_s, train.pixel, train.pulse_width_s) for train in trains for start_s in train.pulse_starts_s())
    starts_s, pixels, widths_s = zip(*rows, strict=True)
    executed = presentation["executed"]
    return (
        executed["pixel"] == list(pixels)
        and np.allclose(executed["width_s"], widths_s, rtol=0, atol=2e-6)
        and np.allclose(executed["start_s"], starts_s, rtol=0, atol=2e-4)  # the PWM's period
    )


def assert_on_the_board(presentation, logged):
    """Assert that the board's own log has a presentation's pulses, one after the other, with their widths and times."""
    executed = presentation["executed"]
    starts_us = [round(1e6 * start_s) for start_s in executed["start_s"]]
    widths_us = [round(1e6 * width_s) for width_s in executed["width_s"]]
    count = len(starts_us)
    assert any(
        [off - on for on, off in logged[k : k + count]] == widths_us
        and all(abs(on - logged[k][0] - at) <= 2 for (on, _), at in zip(logged[k : k + count], starts_us, strict=True))
        for k in range(len(logged) - count + 1)
    )
