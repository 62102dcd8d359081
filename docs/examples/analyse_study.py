"""Accuracies and thresholds of a dataset, from its BIDS files alone.

python analyse_study.py FOLDER TASK

Prints the numbers of `optodrive study report FOLDER` as JSON. It needs numpy and scipy, and nothing of optodrive:
change it, or take the tables from here into pandas or R.
"""

import csv
import json
import sys
from pathlib import Path

import numpy as np
from scipy.stats import beta, t

LAPSES = ((0.0, 0.31), (0.025, 0.31), (0.05, 0.31), (0.1, 0.04), (0.2, 0.02), (0.35, 0.01))
GUESSES = ((0.02, 0.25), (0.05, 0.2), (0.1, 0.2), (0.2, 0.2), (0.35, 0.15))


def read_trials(folder, task):
    """Return the description of a task's tables, and their rows with the participant, from all sessions."""
    paths = sorted(
        [*folder.glob(f"sub-*/beh/*_task-{task}_beh.tsv"), *folder.glob(f"sub-*/ses-*/beh/*_task-{task}_beh.tsv")]
    )
    if not paths:
        raise SystemExit(f"{folder}: no table of the task {task}")
    rows = []
    for path in paths:
        entities = dict(part.split("-", 1) for part in path.stem.split("_")[:-1])
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file, delimiter="\t"):
                rows.append({**row, "participant": entities["sub"], "session": entities.get("ses", "")})
    return json.loads(paths[0].with_suffix(".json").read_text(encoding="utf-8")), rows


def counts(row):
    """Return whether a trial counts: neither practice nor a catch trial, neither excluded nor without an answer."""
    is_main = row.get("phase") != "practice" and row.get("is_catch") != "1"
    return is_main and row.get("exclusion", "n/a") == "n/a" and row["answer"] != "n/a"


def describe_share(correct, trials):
    """Return the share of correct answers with its exact 95 % interval (Clopper and Pearson)."""
    low = 0.0 if correct == 0 else beta.ppf(0.025, correct, trials - correct + 1)
    high = 1.0 if correct == trials else beta.ppf(0.975, correct + 1, trials - correct)
    return {"correct": correct, "trials": trials, "share": correct / trials, "interval": [float(low), float(high)]}


def describe_mean(values):
    """Return the mean over participants with its 95 % interval (Student)."""
    half = t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return {"mean": float(np.mean(values)), "low": float(np.mean(values) - half), "high": float(np.mean(values) + half)}


def estimate_threshold(levels, guess, slopes, level, is_correct):
    """Return median and central 95 % interval of the threshold of a Weibull function, from a grid.

    levels: of the design; guess: the share of correct answers by guessing, None if it is to be fitted
    slopes: of the grid
    """
    logs = np.linspace(np.log(levels[0] / 4.0), np.log(levels[-1] * 4.0), 121)
    total = np.zeros(len(logs))
    habits = [(g, lapse, p * q) for g, p in (GUESSES if guess is None else ((guess, 1.0),)) for lapse, q in LAPSES]
    scores = []
    for guess_rate, lapse, prior in habits:
        drive = np.exp(slopes[None, :, None] * (np.log(level)[None, None, :] - logs[:, None, None]))
        share = np.minimum(guess_rate + (1.0 - guess_rate - lapse) * -np.expm1(-drive), 1.0 - 1e-9)
        scores.append(np.log(np.where(is_correct, share, 1.0 - share)).sum(axis=2) + np.log(prior))
    largest = max(score.max() for score in scores)
    for score in scores:
        total += np.exp(score - largest).sum(axis=1)
    step = logs[1] - logs[0]
    cumulated = np.append(0.0, np.cumsum(total / total.sum()))
    edges = np.append(logs - step / 2, logs[-1] + step / 2)
    low, median, high = np.exp(np.interp([0.025, 0.5, 0.975], cumulated, edges))
    return {"threshold": float(median), "low": float(low), "high": float(high)}


def analyse(folder, task):
    """Return the results of a task."""
    description, rows = read_trials(folder, task)
    main = [row for row in rows if counts(row)]
    judged = [row for row in main if row["is_correct"] != "n/a"]
    people = list(dict.fromkeys(row["participant"] for row in rows))
    results = {"participants": {}, "thresholds": []}
    for person in people:
        correct = [row["is_correct"] == "1" for row in judged if row["participant"] == person]
        if correct:
            results["participants"][person] = describe_share(sum(correct), len(correct))
    if results["participants"]:
        results["accuracy"] = describe_mean([each["share"] for each in results["participants"].values()])
    column = description["Analysis"]["Level"]
    if column is None or description["Analysis"].get("EqualInterval"):
        return results
    levels = sorted({*map(float, description[column]["Levels"]), *(float(row[column]) for row in main)})
    is_yes_no = len({row["correct_answer"] for row in judged}) < 2
    guess = None if is_yes_no else description["Analysis"]["GuessRate"]
    slopes = np.geomspace(*description["Analysis"]["Slopes"], 7)
    for key in dict.fromkeys((row["participant"], row["session"], row.get("block", "")) for row in judged):
        own = [row for row in judged if (row["participant"], row["session"], row.get("block", "")) == key]
        tested = np.array([float(row[column]) for row in own])
        found = estimate_threshold(levels, guess, slopes, tested, np.array([row["is_correct"] == "1" for row in own]))
        found["is_within_levels"] = bool(tested.min() <= found["threshold"] <= tested.max())
        results["thresholds"].append({"participant": key[0], "session": key[1] or None, **found})
    return results


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("usage: python analyse_study.py FOLDER TASK")
    print(json.dumps(analyse(Path(sys.argv[1]), sys.argv[2]), indent=2))
