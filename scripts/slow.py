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
    "accuracy": 3,
    "blind": 2,
    "browser": 1,
    "conformance": 3,
    "dac": 2,
    "docs": 1,
    "firmware": 2,
    "independent": 1,
    "property": 4,
    "scripts": 1,
    "system": 4,
    "unit": 1,
}
"""Folders of tests → the number of pieces that their files are dealt out to."""


def read_nightly() -> dict[str, str]:
    """Return the beginnings of the names of tests that went to the nightly run, and what covers each in the gate."""
    with (ROOT / "tests" / "nightly.csv").open(newline="") as file:
        return {row["name"]: row["covered_by"] for row in csv.DictReader(file)}


def list_pieces() -> dict[str, list[str]]:
    """Return the names of the pieces, such as `property-2`, and the files of each."""
    pieces: dict[str, list[str]] = {}
    nightly = {name.partition("::")[0] for name in read_nightly()}
    for folder, count in FOLDERS.items():
        files = sorted((ROOT / "tests" / folder).rglob("test_*.py"))
        names = [str(file.relative_to(ROOT)) for file in files]
        slow = [
            name
            for name, file in zip(names, files, strict=True)
            if folder == "property" or name in nightly or "mark.slow" in file.read_text()
        ]
        for part in range(count):
            pieces[folder if count == 1 else f"{folder}-{part + 1}"] = slow[part::count]
    return pieces


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


def run_piece(name: str, files: list[str]) -> dict[str, str]:
    """Run the slow tests of files, and those of properties with all examples. Return the table's row."""
    select = [] if name.startswith("property") else ["-m", "slow"]
    command = [sys.executable, "-m", "pytest", "-v", *files, *select, "--numprocesses", "2", "--dist", "loadfile"]
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
    pieces, rows = list_pieces(), read_rows()
    if unknown := [name for name in arguments if name not in pieces]:
        print(f"scripts/test --slow: piece: got {unknown[0]!r}, expected one of {', '.join(pieces)}", file=sys.stderr)
        return 2
    status = 0
    for name in arguments or [choose_piece(list(pieces), rows)]:
        row = run_piece(name, pieces[name])
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
