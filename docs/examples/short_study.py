"""A short study of the direction of motion, with the Python client alone.

python short_study.py answers.tsv

Start the daemon first, on this computer. The script arms the display for its own time. It shows each direction twice in
an order drawn from SEED and writes one line per trial, on the disk before the next one.
"""

import csv
import os
import random
import sys
import time

from optodrive.client import Display
from optodrive.core.errors import OptodriveError

DIRECTIONS = ("left", "right", "up", "down")
REPETITIONS, SEED, PAUSE_S = 2, 7, 1.0


def show(display, direction, trial):
    """Show a stimulus and return when its last pulse ended, on the clock of time.monotonic()."""
    plan = display.play("experiment-1", direction=direction, policy="refuse", labels={"trial": trial})
    if plan.executed != plan.planned or plan.onset is None:
        raise SystemExit(f"trial {trial}: {plan.executed} of {plan.planned} pulses were executed")
    pulses = plan.executed_pulses
    ends_s = [start_s + width_s for start_s, width_s in zip(pulses.start_s, pulses.width_s, strict=True)]
    return plan.onset.monotonic_s + max(ends_s) - pulses.start_s[0]


def ask(question):
    """Ask until one of the directions is typed, and return it."""
    while (answer := input(question).strip()) not in DIRECTIONS:
        print(f"{answer!r} is none of {', '.join(DIRECTIONS)}")
    return answer


def run(table, file):
    """Show all trials and write a line for each."""
    order = list(DIRECTIONS) * REPETITIONS
    random.Random(SEED).shuffle(order)
    with Display() as display:  # stops and disarms at the end, however it comes
        display.arm(hold=True)
        for trial, direction in enumerate(order, start=1):
            end_s = show(display, direction, trial)
            answer = ask(f"{trial} of {len(order)}. Left, right, up or down? ")
            table.writerow([trial, direction, answer, round(time.monotonic() - end_s, 4)])
            file.flush()
            os.fsync(file.fileno())
            time.sleep(PAUSE_S)


def main():
    """Run the study with the table that the command line names."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: python short_study.py answers.tsv")
    try:
        with open(sys.argv[1], "x", newline="", encoding="utf-8") as file:
            table = csv.writer(file, delimiter="\t", lineterminator="\n")
            table.writerow(["trial", "direction", "answer", "response_time_s"])
            run(table, file)
    except EOFError:
        raise SystemExit("answer: no line; the table holds the trials so far") from None
    except (OSError, OptodriveError) as error:
        raise SystemExit(f"short_study: {error}") from None


if __name__ == "__main__":
    main()
