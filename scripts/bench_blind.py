"""The diagnosis, blind: sample hidden effects from seeds, diagnose them, score and print the table.

Development seeds start at 9,000,000, report seeds at 3,000,000; nothing is tuned on the latter.
"""

import json
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import measuring  # noqa: F401 - the folder of the tests

FIRST_SEEDS = {"dev": 9_000_000, "report": 3_000_000}
OPTIONS = {
    "--seeds": {"choices": tuple(FIRST_SEEDS), "default": "dev"},
    "--nulls": {"type": int, "default": 24},
    "--cases": {"type": int, "default": 18, "help": "cases of each other block"},
    "--thin": {"type": int, "help": "run this many cases of one cause instead, with two groups of runs each"},
    "--skip": {"type": int, "default": 0, "help": "seeds of each block to skip"},
    "--workers": {"type": int, "default": os.cpu_count() or 1},
    "--save": {"type": Path, "help": "folder for the answers"},
}
SAMPLES = 30_000
REDUCED_GROUPS = 2
"""Groups of runs in a reduced recording."""


def run_case(task: tuple[str, int]) -> dict[str, Any]:
    """Sample, diagnose and score one case. Repeat it after the recommended experiment where the answer is ambiguous."""
    from blind_lab import draw_case
    from blind_score import score_answer

    block, seed = task
    with TemporaryDirectory() as folder:
        try:
            case = draw_case("single" if block == "thin" else block, seed, folder)
            if block == "thin":
                reduce_recording(case.path, seed)
        except RuntimeError as error:  # some seeds hide nothing that the data could show
            return {"block": block, "seed": seed, "skipped": str(error)}
        answer = diagnose_recording(case.path)
        repeated_answer, experiment = None, answer["next_experiment"]
        if answer["verdict"] == "ambiguous" and experiment is not None:
            repeated_answer = diagnose_recording(
                case.measure(
                    experiment["pulses"],
                    experiment["signals"],
                    folder,
                    pixel=experiment["pixel"],
                    repeats=experiment["repeats"],
                )
            )
        scored = replace(score_answer(case, answer, after=repeated_answer), block=block)
    return {"score": scored, "baselines": name_baseline_causes(answer), "answer": answer}


def reduce_recording(path: Path, seed: int) -> None:
    """Delete all but a few groups of runs: short recordings make causes indistinguishable."""
    import h5py
    import numpy as np

    with h5py.File(path, "a") as file:
        runs = file["runs"]
        groups = sorted({run.attrs["group"] for run in runs.values()})
        kept_groups = set(
            np.random.default_rng([seed, 5]).choice(groups, min(REDUCED_GROUPS, len(groups)), replace=False).tolist()
        )
        for name in [name for name, run in runs.items() if run.attrs["group"] not in kept_groups]:
            del runs[name]


def diagnose_recording(path: Path) -> dict[str, Any]:
    """Return the answer that `optodrive diagnose` gives."""
    from optodrive.lab.diagnosis.diagnose import diagnose
    from optodrive.lab.diagnosis.narrative import build_answer
    from optodrive.lab.diagnosis.nominal_fit import build_prior
    from optodrive.lab.recording import read_recording

    measurement = read_recording(path)
    prior, _ = build_prior(measurement, None)
    return json.loads(json.dumps(build_answer(diagnose(measurement, 0, prior))))


def name_baseline_causes(answer: dict[str, Any]) -> dict[str, str]:
    """Return the cause that each simpler rule names from the same likelihood ratios, "" for none."""
    from math import log

    from optodrive.physics.terms import discover_terms

    def best(price: float) -> str:
        criterion = {
            item["cause"]: item["statistic"] - price * len(discover_terms()[item["cause"]].parameters) for item in rows
        }
        name = max(criterion, key=criterion.__getitem__)
        return name if criterion[name] > 0 else ""

    rows = answer["candidates"]
    return {"largest R²": best(0.0), "AIC": best(2.0), "BIC": best(log(SAMPLES))}


def format_comparison(done: list[dict[str, Any]]) -> str:
    """Format the comparison with simpler rules as Markdown."""
    from blind_score import wilson

    lines = [
        "| rule | nulls without a cause | single cause identified | cause outside the catalogue not named |",
        "|---|---|---|---|",
    ]
    rules = {"this method": None, "largest R²": "largest R²", "AIC": "AIC", "BIC": "BIC"}
    for name, rule in rules.items():
        cells = []
        for block in ("none", "single", "unknown"):
            hits = []
            for item in done:
                scored = item["score"]
                if scored.block != block or "sensor_scale" in scored.causes:
                    continue
                if rule is None:
                    named = scored.named if scored.verdict == "cause" else ()
                else:
                    named = (item["baselines"][rule],) if item["baselines"][rule] else ()
                hits.append(set(named) == set(scored.causes) if block == "single" else not named)
            if not hits:
                cells.append("–")
                continue
            low, high = wilson(sum(hits), len(hits))
            cells.append(f"{sum(hits)}/{len(hits)} ({100 * low:.0f} to {100 * high:.0f} %)")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def measure(seeds, nulls, cases, thin, skip, workers, save):
    """Yield the tables as text."""
    from rich.console import Console
    from rich.progress import track

    from blind_score import format_table

    counts = {"thin": thin} if thin else {"none": nulls, "single": cases, "unknown": cases, "pair": cases}
    first = FIRST_SEEDS[seeds] + skip
    tasks = [(block, first + row) for block, count in counts.items() for row in range(count)]
    with ProcessPoolExecutor(workers) as pool:
        answers = pool.map(run_case, tasks)
        done = list(track(answers, total=len(tasks), console=Console(stderr=True), description="blind"))
    for (block, seed), item in zip(tasks, done, strict=True):
        if "skipped" in item:
            yield f"not sampled: {block} {seed}: {item['skipped']}"
        elif save is not None:
            save.mkdir(parents=True, exist_ok=True)
            (save / f"{block}-{seed}.json").write_text(json.dumps(item["answer"], indent=1))
    scored = [item for item in done if "score" in item]
    yield format_table(item["score"] for item in scored)
    yield format_comparison(scored)
