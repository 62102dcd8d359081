"""Tables of trials of simulated participants, written here as BIDS states them."""

import json

import numpy as np

COLUMNS = ("trial", "block", "phase", "is_catch", "level", "answer", "correct_answer", "is_correct", "exclusion")
LEVELS = tuple(np.geomspace(10.0, 1000.0, 9).round(3).tolist())


def write_table(
    folder, participant, rows, *, session=None, task="felt", answers=("left", "right"), level="level", **more
):
    """Write rows, each with some of COLUMNS, as a participant's table with its description."""
    ses = [] if session is None else [f"ses-{session}"]
    beh = folder.joinpath(f"sub-{participant}", *ses, "beh")
    beh.mkdir(parents=True, exist_ok=True)
    path = beh / ("_".join([f"sub-{participant}", *ses, f"task-{task}"]) + "_beh.tsv")
    common = {"block": "main", "phase": "main", "is_catch": 0, "exclusion": "n/a", "response_time": 1.0}
    names = [*COLUMNS, "response_time"]
    lines = ["\t".join(names)]
    for number, row in enumerate(rows, start=1):
        correct = row.get("correct_answer", "n/a")
        is_correct = "n/a" if correct == "n/a" else int(row["answer"] == correct)
        cells = {"trial": number, "correct_answer": correct, "is_correct": is_correct, "level": "n/a", **common, **row}
        lines.append("\t".join(str(cells[name]) for name in names))
    path.write_text("\n".join(lines) + "\n")
    analysis = {"GuessRate": None, "Level": level, "EqualInterval": None, "Factors": [], **more}
    levels = {str(value): str(value) for value in LEVELS}
    description = {
        "TaskDescription": f"{task}: a test",
        "answer": {"Levels": {answer: answer for answer in answers}},
        "level": {"Levels": levels},
        "Analysis": analysis,
    }
    path.with_suffix(".json").write_text(json.dumps(description))
    return path


def answer_levels(seed, threshold=100.0, *, answers=("left", "right"), repetitions=12, keys=None):
    """Return rows of constant stimuli by a person who guesses an answer where nothing is felt. keys: as pressed."""
    rng, rows = np.random.default_rng(seed), []
    for level in rng.permutation(np.repeat(LEVELS, repetitions)).tolist():
        correct = str(rng.choice(answers))
        is_felt = rng.random() < 1.0 - np.exp(-((level / threshold) ** 3.0))
        given = correct if is_felt else str(rng.choice(answers))
        rows.append({"level": level, "answer": (keys or {}).get(given, given), "correct_answer": correct})
    return rows


def write_thresholds(folder):
    """Write a task with a clear threshold, with a bound, with exchanged keys and with trials that do not count."""
    write_table(folder, "01", answer_levels(1))
    write_table(folder, "02", answer_levels(2, 1.0))
    write_table(folder, "03", answer_levels(3, keys={"left": "right", "right": "left"}))
    rows = answer_levels(4)
    rows += [{**row, "is_catch": 1, "level": "n/a"} for row in rows[:4]] + [{**rows[0], "phase": "practice"}]
    write_table(folder, "04", [*rows, {**rows[1], "exclusion": "too_fast"}])
    return folder
