"""When Python collects garbage: a command and the processes that it starts."""

import subprocess
import sys

from optodrive.core.processes import COMMAND_THRESHOLD, USUAL_THRESHOLDS

CODE = """
import gc
from optodrive.core.processes import collect_seldom, settle_memory
class Node: pass
collect_seldom()
print(gc.get_threshold()[0])
node = Node(); node.me = node; del node
settle_memory()
print(*gc.get_threshold(), gc.get_freeze_count() > 0, sum(isinstance(item, Node) for item in gc.get_objects()))
"""


def test_a_lasting_process_collects_as_usual_and_frees_what_the_start_left():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    seldom, *usual = done.stdout.split()
    assert int(seldom) == COMMAND_THRESHOLD
    assert usual == [*map(str, USUAL_THRESHOLDS), "True", "0"]
