"""Runs benchmarks, and prints their rows.

A benchmark is a module bench_NAME whose `measure` yields rows (`measuring.Row`, or its first values as a tuple) or
text. `OPTIONS` are the arguments that it takes, by the flag of each.
"""

import argparse
import json
import os
import platform
import sys
from importlib import import_module
from pathlib import Path

from measuring import HEADING, Row, format_line

NAMES = sorted(path.stem.removeprefix("bench_") for path in Path(__file__).parent.glob("bench_*.py"))
USUAL = ("plan", "limit", "wire", "board", "hour", "display", "field", "stream", "memory", "order", "page")
"""Those that run without a name."""


def run(name, arguments=()):
    """Run one benchmark with its arguments. Print its rows as they come, or return them where JSON is asked for."""
    module = import_module(f"bench_{name}")
    parser = argparse.ArgumentParser(prog=f"scripts/bench {name}", description=module.__doc__)
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")
    for flag, settings in getattr(module, "OPTIONS", {}).items():
        parser.add_argument(flag, **settings)
    options = vars(parser.parse_args(arguments))
    is_json, rows = options.pop("json"), []
    try:
        for item in module.measure(**options):
            if isinstance(item, str):
                print(item, file=sys.stderr if is_json else sys.stdout, flush=True)
                continue
            row = (item if isinstance(item, Row) else Row(*item)).report()
            row["name"] = row["name"] or name
            if not is_json:
                print(format_line(row) if rows else f"{HEADING}\n{format_line(row)}", flush=True)
            rows.append(row)
    finally:
        if is_json:
            print(json.dumps(rows, indent=1))


def main(arguments):
    if arguments[:1] and not arguments[0].startswith("-"):
        if arguments[0] not in NAMES:
            raise SystemExit(f"scripts/bench: got {arguments[0]!r}, expected one of {', '.join(NAMES)}")
        run(arguments[0], arguments[1:])
    else:
        for name in USUAL:
            run(name, arguments)
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    about = f"{platform.machine()}, {os.cpu_count()} cores, load averages {load}, including these processes"
    print(about, file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1:])
