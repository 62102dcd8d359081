"""Calibration of the diagnosis's probabilities on recordings of 3 to 30 σ, from a generator without its code.

Each call adds rows for the next seeds to a table, and prints everything that the table says. Report seeds start at
6,100,000, development seeds at 9,500,000; nothing is tuned on the former.
"""

import csv
import os
import warnings
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from itertools import count, islice, pairwise
from math import exp, log
from pathlib import Path
from statistics import NormalDist, median
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from measuring import ROOT

FIRST_SEEDS = {"dev": 9_500_000, "report": 6_100_000}
TABLE = ROOT / "docs" / "reference" / "calibration.csv"
OPTIONS = {
    "--seeds": {"choices": tuple(FIRST_SEEDS), "default": "report"},
    "--minutes": {"type": float, "default": 15.0, "help": "no recording is begun later; 0 only prints the table"},
    "--recordings": {"type": int, "help": "largest number of recordings to add"},
    "--skip": {"type": int, "default": 0, "help": "number of the first seeds that are left to another computer"},
    "--workers": {"type": int, "default": 1},
    "--table": {"type": Path, "help": "default: docs/reference/calibration.csv, or calibration-dev.csv here"},
}
HEAD = "# optodrive-calibration 1: scripts/bench calibration --seeds {seeds}"
COLUMNS = (
    *("seed", "kind", "causes", "forms", "target_sigma", "sigma", "rivals", "verdict", "named", "probabilities"),
    *("ruled_out", "aic", "bic", "elapsed_s", "code"),
)
KINDS = ("none", "single", "none", "unknown", "none", "single", "none", "single", "none", "single", "instrument")
KINDS += ("none", "single", "none", "pair", "none", "single", "none", "unknown", "none", "single")
"""Kinds of the recordings, over and over: as often as the diagnosis believes beforehand, and one instrument."""
STRENGTHS = (3.0, 5.0, 8.0, 12.0, 30.0)
INSTRUMENT_FACTOR = 10.0
"""Strength of an instrument's disturbance, which lasts for all of a recording, relative to that of an effect."""
NO_EFFECT, NONE_OF_THESE = "no_effect", "none_of_these"
SHOWN = 1e-3
"""Smallest probability that the table keeps."""
BINS = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)
FALSE_ALARM_LEVEL, NAMED_ODDS = 0.01, log(0.97 / 0.03)
"""Of the ideal observer: its level of false alarms, and the logarithm of the odds from which it names."""


@dataclass(frozen=True)
class Task:
    """One recording of the series."""

    seed: int
    kind: str
    strength: float


def build_task(seeds: str, number: int) -> Task:
    """Return the recording with this number: each kind with every strength in turn."""
    strength = STRENGTHS[(number + number // len(KINDS)) % len(STRENGTHS)]
    kind = KINDS[number % len(KINDS)]
    return Task(FIRST_SEEDS[seeds] + number, kind, strength * (INSTRUMENT_FACTOR if kind == "instrument" else 1.0))


def run_task(task: Task) -> dict[str, str]:
    """Return the row of one recording, of which only the task is filled in where no effect has that strength."""
    from blind_rivals import compute_case_rivals
    from blind_strength import draw_case_of_strength

    row = dict.fromkeys(COLUMNS, "") | {"seed": str(task.seed), "kind": task.kind, "code": compute_code()}
    row["target_sigma"] = f"{task.strength:g}" if task.kind != "none" else ""
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        case = draw_case_of_strength(task.kind, task.strength, task.seed, folder)
        if case is None:
            return row
        answer = diagnose_recording(case.path)
        rivals = compute_case_rivals(case) if task.kind in ("single", "unknown") else {}
    distances = [(name, sigma) for name, sigma in rivals.items() if name and name not in case.causes]
    return row | {
        "causes": "+".join(sorted(case.causes)),
        "forms": "+".join(effect.form.replace(" ", "_") for effect in case.effects),
        "sigma": f"{case.effect_sigma:.2f}",
        "rivals": " ".join(f"{name}:{sigma:.2f}" for name, sigma in distances[:2]),
        **answer,
    }


@cache
def compute_code() -> str:
    """Return a short digest of the code that diagnoses: rows of other code do not describe this one."""
    digest = sha256()
    for folder in ("lab/diagnosis", "lab/inference", "lab/inspection", "physics"):
        for path in sorted((ROOT / "optodrive" / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


def diagnose_recording(path: Path) -> dict[str, str]:
    """Return the columns of the table that the diagnosis fills."""
    from optodrive.lab.diagnosis.dataset import build_dataset, build_hypotheses
    from optodrive.lab.diagnosis.diagnose import diagnose
    from optodrive.lab.diagnosis.nominal_fit import build_prior
    from optodrive.lab.recording import read_recording

    measurement = read_recording(path)
    prior, _ = build_prior(measurement, None)
    found = diagnose(measurement, 0, prior)
    stated = found.probabilities
    explanations = {NO_EFFECT: stated.no_effect, NONE_OF_THESE: stated.none_of_these}
    explanations |= {"+".join(keys): probability for keys, probability in stated.ranked}
    data = build_dataset(measurement)
    numbers = {item.label: item.degrees for part in data.split_subsystems() for item in build_hypotheses(part)}
    ratios = [(item.cause, item.statistic, numbers[item.label]) for item in found.candidates]
    return {
        "verdict": found.verdict,
        "named": "+".join(sorted(found.causes)),
        "probabilities": format_probabilities(explanations),
        "ruled_out": "+".join(sorted({item.cause for item in found.candidates if item.verdict == "ruled out"})),
        "aic": format_probabilities(compute_weights(ratios, 2.0)),
        "bic": format_probabilities(compute_weights(ratios, log(len(data.value)))),
        "elapsed_s": f"{found.elapsed_s:.1f}",
    }


def compute_weights(ratios: list[tuple[str, float, int]], price: float) -> dict[str, float]:
    """Return the weights exp(−IC / 2) of every cause and of no effect from likelihood ratios, normalised.

    ratios: cause, likelihood ratio against the nominal fit and number of parameters of every hypothesis
    """
    logs = {NO_EFFECT: 0.0}
    for cause, ratio, parameters in ratios:
        logs[cause] = max(logs.get(cause, -1e9), 0.5 * (ratio - price * parameters))
    highest = max(logs.values())
    total = sum(exp(value - highest) for value in logs.values())
    return {name: exp(value - highest) / total for name, value in logs.items()}


def format_probabilities(explanations: dict[str, float]) -> str:
    """Return name:probability of those from SHOWN on, joined by spaces."""
    return " ".join(f"{name}:{value:.3f}" for name, value in explanations.items() if value >= SHOWN)


def parse_probabilities(text: str) -> dict[str, float]:
    """Return the numbers of a column by name."""
    return {name: float(value) for name, _, value in (item.rpartition(":") for item in text.split())}


def read_table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table, none where there is no file yet."""
    if not path.exists():
        return []
    lines = path.read_text().splitlines()
    if lines[:1] != [HEAD.format(seeds="report")] and lines[:1] != [HEAD.format(seeds="dev")]:
        raise SystemExit(f"{path}: got {lines[:1]}, expected a table that scripts/bench calibration wrote")
    return list(csv.DictReader(lines[1:]))


def write_table(path: Path, seeds: str, rows: list[dict[str, str]]) -> None:
    """Write a table, in order of the seeds, in place of the old one at once."""
    new = path.with_name(f".{path.name}.new")
    with new.open("w", newline="") as file:
        print(HEAD.format(seeds=seeds), file=file)
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(sorted(rows, key=lambda row: int(row["seed"])))
    new.replace(path)


def find_truth(row: dict[str, str]) -> str:
    """Return the name of the true explanation of a row."""
    return {"none": NO_EFFECT, "instrument": NO_EFFECT, "unknown": NONE_OF_THESE}.get(row["kind"], row["causes"])


def is_detected(row: dict[str, str]) -> bool:
    """Return whether the verdict says that something is wrong."""
    return row["verdict"] not in ("none", "undecided", "incomplete")


def is_false_name(row: dict[str, str]) -> bool:
    """Return whether a cause was named that does not act."""
    return row["verdict"] == "cause" and not set(row["named"].split("+")) <= set(row["causes"].split("+"))


def is_named(row: dict[str, str]) -> bool:
    """Return whether the true cause was named, alone or in a set of two."""
    causes, named = set(row["causes"].split("+")), set(row["named"].split("+"))
    return (row["verdict"] == "cause" and named == causes) or (
        row["verdict"] == "ambiguous" and causes <= named and len(named) <= 2
    )


def compute_ideal_detection(row: dict[str, str]) -> float:
    """Return the power of a likelihood-ratio test that knows the effect's form and the noise."""
    normal = NormalDist()
    return normal.cdf(float(row["sigma"]) - normal.inv_cdf(1.0 - FALSE_ALARM_LEVEL))


def compute_ideal_naming(row: dict[str, str]) -> float:
    """Return the largest probability of naming the true cause alone or with its nearest rival.

    The observer knows the true form and the noise, and compares it with the second nearest rival at the odds of a name.
    """
    distance = max(parse_probabilities(row["rivals"]).values(), default=0.0)
    if distance <= 0.0:
        return 0.0
    return min(compute_ideal_detection(row), NormalDist().cdf(0.5 * distance - NAMED_ODDS / distance))


def format_share(hits: int, number: int) -> str:
    """Return hits/number with the 95 % Wilson interval in percent."""
    from blind_score import wilson

    if not number:
        return "–"
    low, high = wilson(hits, number)
    return f"{hits}/{number}, {100 * hits / number:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def format_reliability(rows: list[dict[str, str]]) -> str:
    """Return the reliability diagram as a table: stated probabilities of all explanations and how often they are true.

    Explanations of one recording exclude each other, so the bands, which take them as independent, are narrow.
    """
    from blind_score import wilson

    pairs = []
    for row in rows:
        stated, truth = parse_probabilities(row["probabilities"]), find_truth(row)
        pairs += [(value, name == truth) for name, value in stated.items()]
        pairs += [] if truth in stated else [(0.0, True)]
    lines = [
        "| stated | explanations | mean stated | true, with 95 % band | in the band |",
        "|---|---|---|---|---|",
    ]
    for low, high in pairwise(BINS):
        inside = [(value, hit) for value, hit in pairs if low <= value < high or value == high == 1.0]
        if not inside:
            continue
        mean, hits = sum(value for value, _ in inside) / len(inside), sum(hit for _, hit in inside)
        band = wilson(hits, len(inside))
        lines.append(
            f"| {low:g} to {high:g} | {len(inside)} | {100 * mean:.1f} % | {format_share(hits, len(inside))} | "
            f"{'yes' if band[0] <= mean <= band[1] else 'no'} |"
        )
    return "\n".join(lines)


def compute_brier(rows: list[dict[str, str]], column: str) -> float:
    """Return the mean Brier score over all explanations, 0 to 2."""
    total = 0.0
    for row in rows:
        stated, truth = parse_probabilities(row[column]), find_truth(row)
        total += sum((value - (name == truth)) ** 2 for name, value in stated.items()) + (truth not in stated)
    return total / len(rows)


def find_best(row: dict[str, str], column: str) -> str:
    """Return the explanation that a criterion prefers."""
    stated = parse_probabilities(row[column])
    return max(stated, key=stated.__getitem__)


def format_strengths(rows: list[dict[str, str]]) -> str:
    """Return detection, naming and false names by strength, beside those of an ideal observer and of two criteria."""
    lines = [
        "| σ | detected | ideal | one cause named, alone or of two | ideal | false names | by AIC | by BIC |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for strength in STRENGTHS:
        inside = [row for row in rows if row["target_sigma"] == f"{strength:g}"]
        singles = [row for row in inside if row["kind"] == "single"]
        if not inside:
            continue
        ideal = sum(map(compute_ideal_detection, inside)) / len(inside)
        naming = f"{100 * sum(map(compute_ideal_naming, singles)) / len(singles):.0f} %" if singles else "–"
        detected, false = sum(map(is_detected, inside)), sum(map(is_false_name, inside))
        named = sum(map(is_named, singles))
        criteria = [
            sum(find_best(row, column) not in (NO_EFFECT, *row["causes"].split("+")) for row in inside)
            for column in ("aic", "bic")
        ]
        cells = [format_share(detected, len(inside)), f"{100 * ideal:.0f} %", format_share(named, len(singles)), naming]
        cells += [format_share(hits, len(inside)) for hits in (false, *criteria)]
        lines.append(f"| {strength:g} | {' | '.join(cells)} |")
    return "\n".join(lines)


def format_misses(rows: list[dict[str, str]]) -> list[str]:
    """Return a line for every false name, and for every true cause that was called ruled out."""
    lines = []
    for row in rows:
        about = f"{row['seed']}: {row['causes']} ({row['forms']}) of {row['sigma']} σ, nearest {row['rivals'] or '?'}"
        if is_false_name(row):
            lines.append(f"- false name: {about} → {row['named']}")
        if set(row["ruled_out"].split("+")) & set(row["causes"].split("+")) - {""}:
            lines.append(f"- ruled out though true: {about} → {row['verdict']} {row['named']}")
    return lines


def format_summary(rows: list[dict[str, str]]) -> str:
    """Return everything that a table says, as Markdown."""
    kept = [row for row in rows if row["verdict"]]
    if not kept:
        return "The table is empty."
    nulls = [row for row in kept if row["kind"] == "none"]
    instruments = [row for row in kept if row["kind"] == "instrument"]
    hidden = [row for row in kept if row["kind"] not in ("none", "instrument")]
    codes = {row["code"] for row in kept} - {compute_code()}
    lines = [
        f"{len(kept)} recordings ({len(rows) - len(kept)} not sampled: no size of the effect has that strength); "
        f"elapsed {median(float(row['elapsed_s']) for row in kept):.0f} s in the median.",
        f"{sum(row['code'] in codes for row in kept)} of them were diagnosed by other code than this.",
        f"Undecided nulls: {format_share(sum(row['verdict'] == 'undecided' for row in nulls), len(nulls))}.",
        f"False alarms in nulls: {format_share(sum(map(is_detected, nulls)), len(nulls))}; with AIC "
        + format_share(sum(find_best(row, "aic") != NO_EFFECT for row in nulls), len(nulls))
        + ", with BIC "
        + format_share(sum(find_best(row, "bic") != NO_EFFECT for row in nulls), len(nulls))
        + ".",
        f"False names: {format_share(sum(map(is_false_name, hidden)), len(hidden))}.",
        "Disturbances of an instrument: found "
        + format_share(sum(row["verdict"] == "instrument" for row in instruments), len(instruments))
        + ", taken for a cause in the pixel "
        + format_share(sum(row["verdict"] in ("cause", "ambiguous") for row in instruments), len(instruments))
        + ".",
        "Brier score, 0 to 2: "
        + ", ".join(
            f"{name} {compute_brier(kept, column):.3f}"
            for name, column in (("this method", "probabilities"), ("AIC", "aic"), ("BIC", "bic"))
        )
        + ".",
        "",
        format_reliability(kept),
        "",
        format_strengths(hidden),
        "",
        *format_misses([*hidden, *instruments]),
    ]
    return "\n".join(lines)


def measure(seeds, minutes, recordings, skip, workers, table):
    """Yield a line per recording, then the summary of the table."""
    path = table or (TABLE if seeds == "report" else Path("calibration-dev.csv"))
    rows = read_table(path)
    done = {int(row["seed"]) for row in rows}
    if done and not FIRST_SEEDS[seeds] <= min(done) < FIRST_SEEDS[seeds] + 1_000_000:
        raise SystemExit(f"{path}: got seeds from {min(done)}, expected {seeds} seeds from {FIRST_SEEDS[seeds]}")
    tasks = islice((task for task in (build_task(seeds, k) for k in count(skip)) if task.seed not in done), recordings)
    until_s = monotonic() + 60.0 * minutes
    with ProcessPoolExecutor(workers) as pool:
        running = set()
        while True:
            while len(running) < workers and monotonic() < until_s and (task := next(tasks, None)) is not None:
                running.add(pool.submit(run_task, task))
            if not running:
                break
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                row: dict[str, Any] = future.result()
                rows.append(row)
                write_table(path, seeds, rows)
                about = " ".join(row[name] for name in ("seed", "kind", "causes", "forms", "sigma"))
                yield f"{about} → {row['verdict'] or 'not sampled'} {row['named']}".rstrip()
    yield format_summary(rows)
