"""Run the tests of the gate: those in real time, and beside them those that compute.

The latter say what they found when all have ended.
"""

import subprocess
import sys
import tempfile

LIVE = (
    "tests/system",
    "tests/browser",
    "tests/docs",
    "tests/conformance/test_conformance_pty.py",
)
PYTEST = (sys.executable, "-m", "pytest", "-m", "not slow", "--dist", "loadfile", "--no-loadscope-reorder")


def run_halves(live: list[str], computing: list[str]) -> int:
    """The exit code of two commands run side by side: the first that is not zero, of `live` before `computing`."""
    with (
        tempfile.TemporaryFile("w+") as said,
        subprocess.Popen(computing, stdout=said, stderr=subprocess.STDOUT) as beside,
    ):
        try:
            codes = subprocess.run(live, check=False).returncode, beside.wait()
        finally:
            beside.kill()  # Ctrl-C does not reach what a shell started in the background
            said.seek(0)
            sys.stdout.write(said.read())
    return next((code for code in codes if code != 0), 0)


def main() -> int:
    """Run the gate's tests; those in real time mostly wait, so four at once, and the others take what is left."""
    computing = ["nice", *PYTEST, *(f"--ignore={path}" for path in LIVE), "--numprocesses", "2"]
    return run_halves([*PYTEST, *LIVE, "--numprocesses", "4"], computing)


if __name__ == "__main__":
    sys.exit(main())
