"""The cache of machine code: what invalidates it, and what happens where the folder is not writable."""

import os
import subprocess
import sys

import pytest

IS_COLD = (
    "import optodrive.planning.limiter.pulse_application, optodrive.core.kernels as c;"
    " print(c.is_cold(), c.CACHED, c._FOLDER)"
)
OTHER = """
from typing import NamedTuple

from optodrive.core.kernels import kernel

FACTOR = 2.0


class Pair(NamedTuple):
    first: float
    second: float


@kernel
def scale(x: float) -> float:
    return FACTOR * x
"""
KERNEL = '''
import other
from optodrive.core.kernels import kernel
from other import Pair, scale


@kernel
def total(pair: Pair) -> float:
    """Return the sum."""
    return scale(pair.first) + later(pair.second)


@kernel
def later(x: float) -> float:
    return x + 1.0


print(total(Pair(2.0, 5.0)), sum(total.stats.cache_hits.values()))
'''


def print_state(folder):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    command = [sys.executable, "-c", IS_COLD]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True, timeout=60
    ).stdout.split()


def test_an_empty_folder_is_cold(tmp_path):
    assert print_state(tmp_path) == ["True", "True", str(tmp_path)]


def test_without_a_writable_folder_nothing_is_cached():
    is_cold, cached, _ = print_state("/proc/self/nowhere")
    assert (is_cold, cached) == ("True", "False")


def run_kernel(folder, other, kernel):
    """Value of the kernel, and the number of its signatures that came from the cache."""
    (folder / "other.py").write_text(other)
    (folder / "main.py").write_text(kernel)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, str(folder / "main.py")]
    value, hits = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True, timeout=60
    ).stdout.split()
    return float(value), int(hits)


@pytest.fixture
def folder(tmp_path):
    assert run_kernel(tmp_path, OTHER, KERNEL) == (10.0, 0)
    assert run_kernel(tmp_path, OTHER, KERNEL) == (10.0, 1)
    return tmp_path


def test_comments_and_docstrings_keep_the_machine_code(folder):
    commented = KERNEL.replace("Return the sum.", "Return the sum of both.").replace(
        "import other", "# why\nimport other"
    )
    assert run_kernel(folder, f"# a comment\n{OTHER}", commented) == (10.0, 1)


@pytest.mark.parametrize(
    ("other", "kernel", "value"),
    [
        (OTHER.replace("2.0", "3.0"), KERNEL, 12.0),
        (OTHER.replace("FACTOR * x", "FACTOR * x + 1.0"), KERNEL, 11.0),
        (OTHER.replace("first: float\n    second: float", "second: float\n    first: float"), KERNEL, 13.0),
        (OTHER, KERNEL.replace("x + 1.0", "x + 2.0"), 11.0),
        (OTHER, KERNEL.replace("later(pair.second)", "pair.second"), 9.0),
    ],
    ids=["constant of another file", "callee of another file", "order of fields", "later callee", "own code"],
)
def test_whatever_the_kernel_refers_to_invalidates_it(folder, other, kernel, value):
    assert run_kernel(folder, other, kernel) == (value, 0)


def test_a_constant_read_through_a_module_invalidates_the_kernel(folder):
    kernel = KERNEL.replace("scale(pair.first)", "other.FACTOR * pair.first")
    assert run_kernel(folder, OTHER, kernel) == (10.0, 0)
    assert run_kernel(folder, OTHER, kernel) == (10.0, 1)
