"""Where machine code is kept, and what happens where it cannot be."""

import os
import subprocess
import sys

COLD = (
    "import optodrive.planning.limiter.pulse_application, optodrive.core.kernels as c;"
    " print(c.cold(), c.CACHED, c._FOLDER)"
)


def told(folder):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    return subprocess.run(
        [sys.executable, "-c", COLD], env=environment, capture_output=True, text=True, check=True, timeout=60
    ).stdout.split()


def test_a_new_folder_is_cold_and_named_after_the_sources(tmp_path):
    cold, cached, folder = told(tmp_path)
    assert (cold, cached) == ("True", "True")
    assert folder.startswith(f"{tmp_path}/")


def test_a_folder_that_cannot_be_written_is_done_without():
    cold, cached, _ = told("/proc/self/nowhere")
    assert (cold, cached) == ("True", "False")
