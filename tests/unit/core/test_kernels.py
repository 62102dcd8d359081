"""The cache of machine code: the changes that invalidate it, and the behaviour without a writable folder."""

import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numba.core.errors import TypingError

from optodrive.core.kernels import COMPILER_LIBRARY, array_kernel, code_stamp, kernel, release_compiler

IS_CACHED = (
    "from optodrive.planning.scheduler.visiting_path import path_rad; import optodrive.core.kernels as c;"
    " print(c.is_cached(path_rad), c.CACHED, c._FOLDER)"
)
ANNOUNCED = """
import sys
from optodrive.cli.output import announce_compilation
from optodrive.planning.scheduler.visiting_path import compile_kernels
sys.stderr = sys.stdout
announce_compilation()
compile_kernels()
"""
OTHER = """
from typing import NamedTuple

FACTOR = 2.0
TABLE = (1.0, 2.0)


class Inner(NamedTuple):
    third: float


class Pair(NamedTuple):
    first: float
    second: float
    inner: Inner


def scale(x: float) -> float:
    return FACTOR * x + TABLE[0]
"""
KERNEL = '''
from {other} import Pair, scale


def total(pair: Pair) -> float:
    """Return the sum."""
    return scale(pair.first) + later(pair.second)


def later(x: float, offset: float = 0.0) -> float:
    return x + 1.0 + offset
'''


def stamp(other=OTHER, kernel=KERNEL):
    """Stamp of `total` in two modules made of these sources."""
    for name, source in (("kernel_other", other), ("kernel_main", kernel.replace("{other}", "kernel_other"))):
        sys.modules[name] = ModuleType(name)
        exec(source, vars(sys.modules[name]))
    return code_stamp(sys.modules["kernel_main"].total)


def test_comments_and_docstrings_keep_the_stamp():
    commented = KERNEL.replace("Return the sum.", "Return the sum of both.").replace("from {", "# why\nfrom {")
    assert stamp(f"# a comment\n{OTHER}", commented) == stamp()


@pytest.mark.parametrize(
    ("other", "kernel"),
    [
        (OTHER.replace("FACTOR = 2.0", "FACTOR = 3.0"), KERNEL),
        (OTHER.replace("(1.0, 2.0)", "(1.5, 2.0)"), KERNEL),
        (OTHER.replace("FACTOR * x", "FACTOR * x + 1.0"), KERNEL),
        (OTHER.replace("first: float\n    second: float", "second: float\n    first: float"), KERNEL),
        (OTHER.replace("third", "fourth"), KERNEL),
        (OTHER, KERNEL.replace("x + 1.0", "x + 2.0")),
        (OTHER, KERNEL.replace("offset: float = 0.0", "offset: float = 0.5")),
        (OTHER, KERNEL.replace("later(pair.second)", "pair.second")),
    ],
    ids=[
        "constant of another module",
        "constant in a tuple",
        "callee of another module",
        "order of fields",
        "nested named tuple",
        "callee defined later",
        "default of a callee",
        "own code",
    ],
)
def test_everything_that_a_kernel_refers_to_changes_its_stamp(other, kernel):
    assert stamp(other, kernel) != stamp()


def test_a_named_tuple_that_moves_to_another_module_changes_the_stamp():
    """Else a newer version finds machine code whose index names a module that is gone, and ends with a traceback."""
    before = stamp()
    function = sys.modules["kernel_main"].total
    pair = function.__annotations__["pair"]
    pair.__module__ = "kernel_elsewhere"
    assert code_stamp(function) != before


def test_a_constant_read_through_a_module_of_the_package_changes_the_stamp(monkeypatch):
    kernel = "from optodrive.core import quantity\n\n\ndef total(x: float) -> float:\n    return quantity.FACTOR * x\n"
    monkeypatch.setattr("optodrive.core.quantity.FACTOR", 1.0, raising=False)
    before = stamp(kernel=kernel)
    monkeypatch.setattr("optodrive.core.quantity.FACTOR", 2.0, raising=False)
    assert stamp(kernel=kernel) != before


def create(x):
    return np.zeros(len(x)) + x


def view(x):
    return x[1:]


def sum_of_view(x):
    return x[1:].sum()


@pytest.mark.parametrize("function", [create, view])
def test_a_kernel_that_creates_or_returns_an_array_is_not_compiled_without_reference_counts(function):
    assert array_kernel(function)(np.ones(3)).tolist() == function(np.ones(3)).tolist()
    with pytest.raises(TypingError, match="Only accept returning of array passed into the function as argument"):
        kernel(function)(np.ones(3))  # and not taken from the cache


def test_a_kernel_may_look_at_a_part_of_its_arguments():
    assert kernel(sum_of_view)(np.ones(3)) == 2.0


RUN = """
import sys
sys.path.insert(0, {folder!r})
from optodrive.core import kernels
import main
total = kernels.kernel(main.total)
print(total(3.0), sum(total.stats.cache_hits.values()), "scipy.linalg" in sys.modules)
"""


RUN_AND_COMPILE = """
import sys
sys.path.insert(0, {folder!r})
import numpy as np
from optodrive.core import kernels
import main
total = kernels.array_kernel(main.total)
print(total(np.ones(3))[0], sum(total.stats.cache_hits.values()), "numba.typed.typedlist" in sys.modules)
print(kernels.array_kernel(main.draw)(np.ones(3))[0], "numba.typed.typedlist" in sys.modules)
"""


def run_python(code, folder):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()


def test_machine_code_is_loaded_until_the_kernel_changes(tmp_path):
    """SciPy, whose import takes longer than that of all kernels, is not loaded for it."""
    source = tmp_path / "main.py"
    code = RUN.format(folder=str(tmp_path))
    source.write_text("def total(x: float) -> float:\n    return 2.0 * x\n")
    assert run_python(code, tmp_path / "cache") == ["6.0", "0", "False"]
    source.write_text('def total(x: float) -> float:\n    """Comment."""\n    return 2.0 * x\n')
    assert run_python(code, tmp_path / "cache") == ["6.0", "1", "False"]
    source.write_text("def total(x: float) -> float:\n    return 5.0 * x\n")
    assert run_python(code, tmp_path / "cache") == ["15.0", "0", "False"]


def test_compilation_is_announced_once_and_only_when_a_kernel_is_compiled(tmp_path):
    """Most kernels of the imported modules have no machine code yet in either run."""
    assert run_python(IS_CACHED, tmp_path) == ["False", "True", str(tmp_path)]
    assert " ".join(run_python(ANNOUNCED, tmp_path)) == "optodrive: compiling kernels, up to half a minute, once"
    assert run_python(IS_CACHED, tmp_path) == ["True", "True", str(tmp_path)]
    assert run_python("import optodrive.planning.pipeline\n" + ANNOUNCED, tmp_path) == []


def test_without_a_writable_folder_nothing_is_cached():
    is_cached, cached, _ = run_python(IS_CACHED, "/proc/self/nowhere")
    assert (is_cached, cached) == ("False", "False")


def read_compiler_mib():
    """Return the resident pages of LLVM's library that equal its file, MiB."""
    mappings = re.split(r"(?m)^(?=[0-9a-f]+-)", Path("/proc/self/smaps").read_text())
    found = [text for text in mappings if text.partition("\n")[0].endswith(COMPILER_LIBRARY)]
    rss, own = (sum(int(re.search(rf"{key}: +(\d+)", text)[1]) for text in found) for key in ("Rss", "Anonymous"))
    return (rss - own) / 1024


def test_a_released_compiler_holds_no_memory_and_compiles_again():
    def build_kernel(summand):
        return array_kernel(lambda x: x + summand)

    assert build_kernel(1.0)(1.0) == 2.0
    assert read_compiler_mib() > 20.0
    release_compiler()
    assert read_compiler_mib() < 1.0
    assert build_kernel(2.0)(1.0) == 3.0


def test_loaded_machine_code_needs_nothing_of_the_compiler_which_loads_itself_when_needed(tmp_path):
    code = "import numpy as np\ndef total(x):\n    return np.zeros(3) + x.max()\n"
    changed = "def draw(x):\n    return np.append(x, {}) + 1.0\n"
    (tmp_path / "main.py").write_text(code + changed.format(1.0))
    run_python(RUN_AND_COMPILE.format(folder=str(tmp_path)), tmp_path)
    (tmp_path / "main.py").write_text(code + changed.format(2.0))
    words = run_python(RUN_AND_COMPILE.format(folder=str(tmp_path)), tmp_path)
    assert words == ["1.0", "1", "False", "2.0", "True"]
