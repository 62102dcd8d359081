"""A braille display under BRLTTY: from a kill of either side to the light of the next cells, with its parts.

The kills come at random moments while text is shown. The start of what was killed is measured beside it: BRLTTY's by
its first answer to BrlAPI.
"""

import random
import tempfile
import time
from pathlib import Path

from measuring import Row

from braille_desk import draw_text, running_desk  # of the tests

KILLS = 10
RECOVERY_S = 2.0
OPTIONS = {"--kills": {"type": int, "default": KILLS, "help": "of each side"}}
SHOWN_MAX_S = 1.0


def kill_reader(desk):
    """Kill BRLTTY and start another one. Return the time from the kill, and of that until it answers, s."""
    begin_s = time.monotonic()
    desk.reader.kill()
    desk.writer.close()
    desk.start_reader()
    return begin_s, time.monotonic() - begin_s


def kill_command(desk):
    """Kill `optodrive braille` and start it again. Return the time of the kill, and until it is ready, s."""
    begin_s = time.monotonic()
    desk.command.stop()
    desk.command.start()
    return begin_s, time.monotonic() - begin_s


def measure(kills):
    rng = random.Random(1)
    for name, kill in (("BRLTTY", kill_reader), ("optodrive braille", kill_command)):
        recovered_s, started_s, faults = [], [], 0
        with tempfile.TemporaryDirectory() as folder, running_desk(Path(folder)) as desk:
            for _ in range(kills):
                desk.show(draw_text(rng))
                time.sleep(rng.uniform(0.0, SHOWN_MAX_S))
                begin_s, ready_s = kill(desk)
                cells = draw_text(rng)
                desk.writer.write(cells)
                desk.wait_for_light(cells)
                recovered_s.append(time.monotonic() - begin_s)
                started_s.append(ready_s)
            faults = len(desk.board.of("fault"))
        yield Row(f"{name} killed: until the next cells have light", recovered_s, "s", RECOVERY_S)
        yield Row(f"{name} killed: until its successor answers", started_s, "s")
        yield f"{name} killed: faults of the board", faults, "1"
