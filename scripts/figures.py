"""Write the figures of docs/reference/benchmarks.md: what takes at most twenty minutes, in one run on one machine.

Each row is of the present program and names its command; rows of an earlier run do not stay. What takes longer is not
here: the page states its commands.
"""

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import time
from pathlib import Path

from measuring import ROOT, format_number

PAGE = ROOT / "docs" / "reference" / "benchmarks.md"
BEGIN, END = "<!-- scripts/figures -->", "<!-- end -->"
SHOWN = {
    "plan": r"^50 µm: pulses|^400 µm: pulses limited|shown per second|whole",
    "start": r"pass|stop|status|plan`|start to end",
    "limit": r"400 µm: full frame|1,000,000|after all",
    "wire": r".",
    "board": r"simulated board",
    "hour": r"one hour|over kernel|difference",
    "order": r"(full|50 at random|braille).*(second, (naive|sched)|bound, sched)|experiment-6.*scheduler",
    "field": r"(289|25) spots: rms.*worst geometry|289 spots.*two sigma|positions to codes",
    "page": r"all heights|frames per second|executed|underruns",
    "memory": r"all processes|first answer",
    "stream": r"^(?!.*truncates).*(first light|^(WebSocket: )?arrival to first byte|^round trip.*bare|"
    r"frame of (200|1511).*, limited|shown per second of (20|60|200)|underruns)",
    "stop": r"gate off, (rest|refused bodies|slow bodies|idle|connection|callers|fragmented|telemetry that is not)|"
    r"^rest: pulses after STOP",
    "fingers": r"dots under|first light",
}
"""Rows of each benchmark that the page shows, by a pattern within their quantity."""
OPTIONS = {"fingers": ("--virtual-s", "0")}
"""What a benchmark leaves out here."""


def measure(name):
    """Run a benchmark. Return its rows that the page shows, and how long it took, s."""
    begin_s = time.monotonic()
    command = [sys.executable, str(ROOT / "scripts" / "bench.py"), name, "--json", *OPTIONS.get(name, ())]
    rows = json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True).stdout)
    return [row for row in rows if re.search(SHOWN[name], row["quantity"])], time.monotonic() - begin_s


def format_row(row):
    """Return a line of the list. A single value has neither percentile nor count."""
    unit = "" if row["unit"] == "1" else row["unit"]
    notes = [] if row["n"] == 1 else [f"p99 {format_number(row['p99'])} of {row['n']}"]
    notes += [f"{format_number(row['ratio'])} × {row['reference']}"] if row["ratio"] else []
    text = f"- {row['quantity']}: {format_number(row['median'])} {unit}".rstrip()
    return f"{text} ({'; '.join(notes)})" if notes else text


def describe_machine():
    """Return the machine's kind, date and commit in one sentence."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    commit = subprocess.run(
        ("git", "-C", ROOT, "rev-parse", "--short", "HEAD"), capture_output=True, text=True, check=True
    ).stdout.strip()
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    machine = f"{os.cpu_count()} cores of {model}, Python {platform.python_version()}"
    date = time.strftime("%d %B %Y")
    return f"{date}, commit {commit}, {machine}, load averages at the end {load} with its own processes."


def main():
    parser = argparse.ArgumentParser(prog="scripts/figures", description=__doc__)
    parser.add_argument("names", nargs="*", choices=[[], *SHOWN], help="measure these alone, and print their lines")
    names = parser.parse_args().names or list(SHOWN)
    lines, spent = [], []
    for name in names:
        rows, seconds = measure(name)
        lines += ["", f"**{name}**", "", *map(format_row, rows)]
        spent.append(f"{name} {seconds:.0f}")
        print(f"{name}: {len(rows)} rows in {seconds:.0f} s", file=sys.stderr, flush=True)
    if names != list(SHOWN):
        print("\n".join(lines))
        return
    table = "\n".join((describe_machine(), "Seconds taken: " + ", ".join(spent) + ".", *lines))
    before, _, rest = PAGE.read_text().partition(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n\n{table}\n\n{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()
