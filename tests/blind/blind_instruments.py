"""Faults of instruments and loggers in blind recordings, drawn by (kind, seed), each with its own electronics.

    case = draw_case("single", seed, folder, cause="gas_leak")
    faults = draw_faults("outliers+quantised", seed, case)
    record(case, faults, path)                         # the session of the case, measured with these faults
    outcome = judge(case, faults, diagnose(path))      # blind_verdicts.py states what an answer is allowed to say

    python tests/blind/blind_instruments.py --kinds all --causes none,each --seeds 0:10 --out rows.jsonl

Seeds from 0 to 99 are for development. Seeds from 100 on are for judging: nobody looks at a single case of them.
Everything is determined by kind, seed and cause. A kind is a key of `FAULTS`, several joined by `+`, or `mixed1` to
`mixed4`, which draws that number of kinds by the seed. The cause `each` is one of `NINE`, by the seed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
import zlib
from concurrent.futures import ProcessPoolExecutor, as_completed
from datetime import timedelta
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import h5py
import numpy as np

from blind_causes import Effect, apply_effects
from blind_display import Physics
from blind_faults import FAULTS, Channel, Fault, Rng, Session, Trace, measure_scales, simulate_run
from blind_lab import Case, draw_case
from blind_session import _draw_missing
from blind_strength import draw_case_of_strength
from blind_verdicts import Said, judge

NINE = (
    *("bridge_conductivity", "heat_capacity", "wall_heating", "laser_droop", "power_nonlinearity"),
    *("membrane_creep", "membrane_stiffening", "gas_leak", "absorber_ageing"),
)
"""Causes in the pixel that displacement and temperature show."""
MIXED = tuple(f"mixed{count}" for count in range(1, 5))

KINDS = ("nothing", *FAULTS, "weak")
"""All kinds: `nothing` is the control, `weak` hides a real cause near the limit of detection."""


def draw_faults(kind: str, seed: int, case: Case) -> tuple[Fault, ...]:
    """Draw the faults of one kind, of several joined by `+`, or of `mixed1` to `mixed4`."""
    scales, listed = measure_scales(case), list(FAULTS)
    if kind in MIXED:
        rng = np.random.default_rng([seed, 515, MIXED.index(kind)])
        order = sorted(int(k) for k in rng.choice(len(listed), MIXED.index(kind) + 1, replace=False))
        names = [listed[k] for k in order]
    else:
        names = [] if kind in ("nothing", "weak") else kind.split("+")
    return tuple(FAULTS[name](np.random.default_rng([seed, 516, listed.index(name)]), scales) for name in names)


def record(case: Case, faults: tuple[Fault, ...], path: Path) -> Path:
    """Measure the session of a case again, with these faults, and write it."""
    session, root = Session({}, {}), [case.seed, 517]
    for number, run in enumerate(case.runs):
        started = case.instruments.start + timedelta(seconds=run.session_s)
        session.stamps[run.name] = started.isoformat()
        session.traces[run.name] = {
            name: _measure(case, faults, Channel(_seed(root, number, name), run, name, run.experiment.times[name]))
            for name in run.shown
        }
    for fault in faults:
        if fault.files:
            fault.files(_seed(root, 10_000, fault.kind), session)
    with h5py.File(path, "w") as file, h5py.File(case.path) as drawn:
        file.attrs.update(dict(drawn.attrs))
        for run in case.runs:
            group = file.create_group(f"runs/{run.name}")
            group.attrs.update(dict(drawn[f"runs/{run.name}"].attrs))
            group.attrs["started_at"] = session.stamps[run.name]
            for table in {"pulses", "commands"} & set(drawn[f"runs/{run.name}"]):
                group.create_dataset(table, data=drawn[f"runs/{run.name}/{table}"][()])
            for name, trace in session.traces[run.name].items():
                signal = group.create_group(name)
                signal.attrs["pixel"] = run.experiment.pixel
                if name in case.instruments.stated:
                    signal.attrs["sigma"] = case.instruments.stated[name]
                signal.create_dataset("t_s", data=trace.t_s)
                signal.create_dataset("value", data=trace.value)
    return path


def _seed(root: list[int], number: int, name: str) -> Rng:
    return np.random.default_rng([*root, number, zlib.crc32(name.encode())])


def _measure(case: Case, faults: tuple[Fault, ...], channel: Channel) -> Trace:
    """Return one signal of one run: sensor, noise, converter and logger in this order."""
    acting = [fault for fault in faults if fault.touches(channel.run, channel.name)]
    true_s = channel.t_s
    for fault in acting:
        if fault.instants:
            moved_s, stamps = fault.instants(Channel(channel.rng, channel.run, channel.name, channel.t_s))
            true_s = true_s + (moved_s - channel.t_s)
            channel = Channel(channel.rng, channel.run, channel.name, stamps)
    value = simulate_run(case.truth, channel.run, {channel.name: true_s})[channel.name]
    for fault in acting:
        if fault.analogue:
            value = fault.analogue(channel, value)
    instruments, rng, count = case.instruments, channel.rng, len(value)
    dt = float(channel.t_s[-1] - channel.t_s[0]) / (count - 1)
    value = value + instruments.run_variation.baseline[channel.name] * rng.standard_normal()
    value = value + instruments.colours[channel.name].sample(rng, count, dt)
    value[_draw_missing(rng, count, instruments.missing)] = np.nan
    for fault in acting:
        if fault.digital:
            value = fault.digital(channel, value)
    return Trace(np.asarray(channel.t_s, np.float64), np.asarray(value, np.float64))


def draw_hidden(kind: str, seed: int, cause: str, folder: Path) -> Case:
    """Draw the display of a case: with nothing hidden, with one cause, or with one near the limit of detection."""
    if kind != "weak":
        return draw_case("none", seed, folder) if cause == "none" else draw_case("single", seed, folder, cause=cause)
    rng = np.random.default_rng([seed, 518])
    if seed % 2:
        for attempt in range(100):
            strength = float(rng.choice([3.0, 5.0, 8.0]))
            key = str(rng.choice(NINE))
            case = draw_case_of_strength("single", strength, seed + 10_000 * attempt, folder, (key,))
            if case is not None:
                return case
    case = draw_case("none", seed, folder)
    depth, tau = float(rng.uniform(0.10, 0.16)), float(np.exp(rng.uniform(np.log(8e-3), np.log(30e-3))))
    changes: dict[str, object] = {"droop": (depth, 0.0), "droop_s": (tau, 1.0), "droop_by_power": True}
    effect = Effect("laser_droop", "one_exponential", {"depth": depth, "tau": tau}, changes, True)
    case.truth, case.effects = apply_effects(Physics(**case.base), (effect,)), (effect,)
    case.causes, case.block, case.sizes = ("laser_droop",), "single", {"depth": depth, "tau": tau}
    return case


def choose_cause(kind: str, cause: str, seed: int) -> str:
    """Return the cause of a case: `each` is one of `NINE` by the seed, or one that start times show."""
    if cause != "each":
        return cause
    return ("absorber_ageing", "ambient_drift")[seed % 2] if kind == "stamps" else NINE[seed % len(NINE)]


def diagnose(path: Path) -> Said:
    """Return the answer of the command line to a recording."""
    program = "from optodrive.cli.main import main; main()"
    command = [sys.executable, "-c", program, "diagnose", "--json", "-", str(path)]
    began = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True)
    answer = {}
    if done.returncode == 0:
        try:
            answer = json.loads(done.stdout)
        except ValueError:
            return Said({}, f"Traceback: no JSON on stdout: {done.stdout[:200]}", time.monotonic() - began)
    return Said(answer, done.stderr.strip() if done.returncode else "", time.monotonic() - began)


def diagnose_quickly(path: Path) -> Said:
    """Return the answer of the library: that of the command line without a search for terms outside the catalogue."""
    from optodrive.core.errors import OptodriveError
    from optodrive.lab.diagnosis.diagnose import diagnose as study
    from optodrive.lab.diagnosis.narrative import build_answer
    from optodrive.lab.diagnosis.nominal_fit import build_prior
    from optodrive.lab.recording import read_recording

    began = time.monotonic()
    try:
        measurement = read_recording(path)
        prior, _ = build_prior(measurement, None)
        answer, message = json.loads(json.dumps(build_answer(study(measurement, 0, prior)))), ""
    except OptodriveError as error:
        answer, message = {}, f"optodrive: {error}"
    except Exception:
        answer, message = {}, traceback.format_exc()
    return Said(answer, message, time.monotonic() - began)


def run_case(kind: str, seed: int, cause: str, *, quick: bool = False) -> dict[str, object]:
    """Draw, record, diagnose and judge one case, and return its row."""
    with tempfile.TemporaryDirectory(prefix="blind-") as name:
        folder = Path(name)
        case = draw_hidden(kind, seed, cause, folder)
        faults = draw_faults(kind, seed, case)
        said = (diagnose_quickly if quick else diagnose)(record(case, faults, folder / "recording.h5"))
    outcome = judge(case, faults, said, weak=kind == "weak")
    answer = said.answer
    omitted = said.omissions
    return {
        "kind": kind,
        "seed": seed,
        "cause": "none" if not case.causes else "+".join(case.causes),
        "drawn": [
            {
                "kind": f.kind,
                "form": f.form,
                "signals": f.signals,
                "runs": f.runs if len(f.runs) < 5 else len(f.runs),
                "sizes": f.sizes,
            }
            for f in faults
        ],
        "sizes": case.sizes,
        "verdict": answer.get("verdict") or ("refused" if said.is_refusal else "traceback"),
        "causes": answer.get("causes", []),
        "disturbances": [f"{d.get('form')} {d.get('signal')}" for d in answer.get("disturbances") or ()],
        "omissions": omitted,
        "outcome": outcome.mark,
        "why": outcome.why,
        "keeps_verdict": outcome.keeps_verdict,
        "accuses_pixel": outcome.accuses_pixel,
        "heights": outcome.heights,
        "message": said.message[-600:],
        "no_effect": (answer.get("probabilities") or {}).get("no_effect"),
        "reasons": answer.get("reasons"),
        "remarks": answer.get("remarks"),
        "doubts": answer.get("doubts"),
        "failures": answer.get("failures"),
        "elapsed_s": round(said.elapsed_s, 1),
    }


def format_row(row: dict) -> str:
    """Return one line about a case."""
    parts = [
        [d["form"], *(s.split("_")[0] for s in d["signals"]), *(f"{k}={v:.3g}" for k, v in d["sizes"].items())]
        for d in row["drawn"]
    ]
    drawn = "; ".join(" ".join(part) for part in parts)
    said = row["verdict"] + (" " + "+".join(row["causes"]) if row["causes"] else "")
    return (
        f"{row['outcome']:8} {row['kind']:13} {row['seed']:4} {row['cause']:21} → {said:45} "
        f"left out {len(row['omissions'])}  {row['why']}  [{drawn}] {row['elapsed_s']} s"
    )


def format_table(rows: list[dict]) -> str:
    """Return the counts of each kind, for recordings with nothing hidden and beside a cause."""
    lines = [
        f"{'kind':14} {'beside':8} {'cases':>5} {'right':>6} {'allowed':>8} {'missed':>7} {'wrong':>6} "
        f"{'verdict kept':>13} {'cause said':>11} {'pixel accused':>14}"
    ]
    kinds = [k for k in (*KINDS, *MIXED) if any(r["kind"] == k for r in rows)]
    kinds += sorted({r["kind"] for r in rows} - set(kinds))
    totals = [("ALL", lambda r: r["kind"] not in ("weak", "nothing"))] + [
        (k, lambda r, k=k: r["kind"] == k) for k in kinds
    ]
    for name, matches in [*totals[1:], totals[0]]:
        for beside, hidden in (("nothing", False), ("a cause", True)):
            some = [r for r in rows if matches(r) and (r["cause"] != "none") == hidden]
            if some:
                marks = [sum(r["outcome"] == m for r in some) for m in ("right", "allowed", "missed", "wrong")]
                kept = sum(r["keeps_verdict"] for r in some)
                said = sum(r["verdict"] == "cause" for r in some)
                accused = sum(r["accuses_pixel"] for r in some)
                lines.append(
                    f"{name:14} {beside:8} {len(some):5} {marks[0]:6} {marks[1]:8} {marks[2]:7} {marks[3]:6} "
                    f"{kept:13} {said:11} {accused:14}"
                )
    return "\n".join(lines)


def parse_seeds(text: str) -> range:
    """Return the seeds of `0:10`, or the one of `7`."""
    first, _, end = text.partition(":")
    return range(int(first), int(end) if end else int(first) + 1)


def main() -> None:
    """Run cases, print a line for each and the table at the end."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", default="all", help="all, or kinds separated by commas: " + ", ".join(KINDS))
    parser.add_argument("--causes", default="none,each", help="none, each, nine, or keys of causes")
    parser.add_argument("--seeds", type=parse_seeds, default=range(3), help="0:3; from 100 on for judging only")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--out", type=Path, help="JSON lines: rows are added, and those there are not run again")
    parser.add_argument("--quick", action="store_true", help="call the library, without the search for new terms")
    parser.add_argument("--table", action="store_true", help="only print the table of --out")
    options = parser.parse_args()
    kinds = list(KINDS) if options.kinds == "all" else options.kinds.split(",")
    causes = [c for part in options.causes.split(",") for c in (NINE if part == "nine" else (part,))]
    tasks = dict.fromkeys(
        (kind, seed, "weak" if kind == "weak" else choose_cause(kind, cause, seed))
        for seed in options.seeds
        for kind in kinds
        for cause in causes
    )
    rows = []
    if options.out and options.out.exists():
        rows = [json.loads(line) for line in options.out.read_text().splitlines()]
    done = {(r["kind"], r["seed"], "weak" if r["kind"] == "weak" else r["cause"]) for r in rows}
    tasks = [] if options.table else [task for task in tasks if task not in done]
    with ProcessPoolExecutor(options.processes) as pool:
        for future in as_completed([pool.submit(run_case, *task, quick=options.quick) for task in tasks]):
            row = json.loads(json.dumps(future.result()))
            rows.append(row)
            print(format_row(row), flush=True)
            if options.out:
                with options.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
    print(format_table(rows))


if __name__ == "__main__":
    main()
