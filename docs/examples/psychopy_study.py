"""The same study with PsychoPy, which shows text in its window and stamps the arrow keys that answer.

python psychopy_study.py answers.tsv

Start the daemon first, on this computer. PsychoPy (https://www.psychopy.org) is installed apart from optodrive; the
optodrive client goes into the same environment. Escape ends the study.
"""

import csv
import os
import random
import sys
import time

from optodrive.client import Display
from optodrive.core.errors import OptodriveError

try:
    from psychopy import core, event, visual
except ImportError:
    raise SystemExit("psychopy: missing, expected in this environment: pip install psychopy") from None

DIRECTIONS = ("left", "right", "up", "down")  # also PsychoPy's names of the arrow keys
REPETITIONS, SEED, PAUSE_S = 2, 7, 1.0


def show(display, direction, trial):
    """Show a stimulus and return when its last pulse ended, on the clock of time.monotonic()."""
    plan = display.play("experiment-1", direction=direction, policy="refuse", labels={"trial": trial})
    if plan.executed != plan.planned or plan.onset is None:
        raise SystemExit(f"trial {trial}: {plan.executed} of {plan.planned} pulses were executed")
    pulses = plan.executed_pulses
    ends_s = [start_s + width_s for start_s, width_s in zip(pulses.start_s, pulses.width_s, strict=True)]
    return plan.onset.monotonic_s + max(ends_s) - pulses.start_s[0]


def ask(window, text, end_s):
    """Wait for an arrow key. Return its name and the time from the end of the stimulus to it, s; None for Escape."""
    clock = core.Clock()  # reads zero now, which is this long after the end:
    since_end_s = time.monotonic() - end_s
    write(window, text)
    keys = event.waitKeys(keyList=[*DIRECTIONS, "escape"], timeStamped=clock)  # earlier keys are dropped
    name, time_s = keys[0]
    return None if name == "escape" else (name, since_end_s + time_s)


def write(window, text):
    """Write text on the window."""
    visual.TextStim(window, text=text, height=0.1).draw()
    window.flip()


def run(table, file):
    """Show all trials and write a line for each."""
    order = list(DIRECTIONS) * REPETITIONS
    random.Random(SEED).shuffle(order)
    window = visual.Window(fullscr=True, color="black")
    try:
        with Display() as display:  # stops and disarms at the end, however it comes
            display.arm(hold=True)
            for trial, direction in enumerate(order, start=1):
                write(window, "Feel")
                end_s = show(display, direction, trial)
                answer = ask(window, "In which direction did it move?\n\nPress an arrow key.", end_s)
                if answer is None:
                    return
                table.writerow([trial, direction, answer[0], round(answer[1], 4)])
                file.flush()
                os.fsync(file.fileno())
                write(window, "")
                core.wait(PAUSE_S)
    finally:
        window.close()


def main():
    """Run the study with the table that the command line names."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: python psychopy_study.py answers.tsv")
    try:
        with open(sys.argv[1], "x", newline="", encoding="utf-8") as file:
            table = csv.writer(file, delimiter="\t", lineterminator="\n")
            table.writerow(["trial", "direction", "answer", "response_time_s"])
            run(table, file)
    except (OSError, OptodriveError) as error:
        raise SystemExit(f"psychopy_study: {error}") from None


if __name__ == "__main__":
    main()
