"""Run one piece of the nightly tests, and add its result to the table tests/slow.csv.

Without a name: the piece whose last row is oldest, so that repeated calls run all of them, also after an interruption.
A piece takes at most 20 minutes on two cores; what it has not finished by then is stopped, and the row says so.
"""

import csv
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "tests" / "slow.csv"
COLUMNS = ("piece", "commit", "date", "passed", "failed", "seconds", "ended")
PIECE_MAX_S = 1200.0
FOLDERS = {
    "accuracy": 6,
    "blind": 4,
    "browser": 3,
    "conformance": 8,
    "dac": 8,
    "docs": 1,
    "firmware": 5,
    "independent": 1,
    "property": 8,
    "scripts": 2,
    "system": 8,
    "unit": 2,
}
"""Folders of tests → the number of pieces that their slow tests are dealt out to."""
PIECES = {f"{folder}-{k}": (folder, f"{k}/{count}") for folder, count in FOLDERS.items() for k in range(1, count + 1)}


def read_nightly() -> dict[str, str]:
    """Return the beginnings of the names of tests that went to the nightly run, and what covers each in the gate."""
    with (ROOT / "tests" / "nightly.csv").open(newline="") as file:
        return {row["name"]: row["covered_by"] for row in csv.DictReader(file)}


def read_rows() -> list[dict[str, str]]:
    """Return the rows of the table, oldest first, none while there is no table."""
    if not TABLE.exists():
        return []
    with TABLE.open(newline="") as file:
        return list(csv.DictReader(file))


def choose_piece(names: list[str], rows: list[dict[str, str]]) -> str:
    """Return the piece whose last row is oldest, first of all one without any."""
    last = {row["piece"]: number for number, row in enumerate(rows)}
    return min(names, key=lambda name: last.get(name, -1))


def run_piece(name: str) -> dict[str, str]:
    """Run the slow tests of a piece, and those of properties with all examples. Return the table's row."""
    folder, part = PIECES[name]
    select = ["--piece", part] if folder == "property" else ["--piece", part, "-m", "slow"]
    command = [sys.executable, "-m", "pytest", "-v", f"tests/{folder}", *select, "--numprocesses", "2"]
    command += ["--dist", "loadfile"]
    began_s, found, ended = time.monotonic(), Counter[str](), "yes"
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:  # one for each test: those that had ended count, also of a piece that is stopped
        print(line, end="", flush=True)
        found.update(re.findall(r"^\[gw\d+\] .*? (PASSED|FAILED|ERROR) ", line))
        if time.monotonic() - began_s > PIECE_MAX_S and ended == "yes":
            ended = "no"
            process.send_signal(signal.SIGINT)
    process.wait()
    commit = subprocess.run(["git", "rev-parse", "--short=8", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    return {
        "piece": name,
        "commit": commit.stdout.strip(),
        "date": datetime.now(UTC).date().isoformat(),
        "passed": str(found["PASSED"]),
        "failed": str(found["FAILED"] + found["ERROR"]),
        "seconds": f"{time.monotonic() - began_s:.0f}",
        "ended": ended,
    }


def main(arguments: list[str]) -> int:
    """Run the pieces that are named, or the one that is due."""
    rows = read_rows()
    if unknown := [name for name in arguments if name not in PIECES]:
        print(f"scripts/test --slow: piece: got {unknown[0]!r}, expected one of {', '.join(PIECES)}", file=sys.stderr)
        return 2
    status = 0
    for name in arguments or [choose_piece(list(PIECES), rows)]:
        row = run_piece(name)
        is_new = not TABLE.exists()
        with TABLE.open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            if is_new:
                writer.writeheader()
            writer.writerow(row)
        print(", ".join(f"{key} {value}" for key, value in row.items()))
        status |= row["failed"] != "0" or row["ended"] != "yes"
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
