"""Planning with a diagnosed model: height errors under a hidden effect, cause by cause."""

import os
from pathlib import Path
from tempfile import TemporaryDirectory

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import measuring  # noqa: F401 - the folder of the tests

from blind_causes import CATALOGUE
from blind_lab import draw_case
from blind_loop import close_loop
from optodrive.core.errors import InputError

FIRST_SEED = 7_000_000
"""First seed; no other benchmark uses these seeds."""
ERROR_MIN = 0.005
"""Relative height error below which the effect lies in instruments or mirrors, not in the heights."""
OPTIONS = {"causes": {"nargs": "*"}, "--cases": {"type": int, "default": 3, "help": "cases per cause"}}


def measure(causes=(), cases=3):
    reductions = []
    for number, cause in enumerate(causes or CATALOGUE):
        for seed in range(FIRST_SEED + 100 * number, FIRST_SEED + 100 * number + cases):
            name = f"{cause} {seed}"
            with TemporaryDirectory() as folder:
                try:
                    loop = close_loop(draw_case("single", seed, folder, cause=cause), Path(folder))
                except InputError as error:
                    yield f"{name}  refused: {error}"
                    continue
            note = f"{'+'.join(loop.causes) or loop.verdict}, trimmed {loop.trimmed}"
            yield f"{name}: height error of the nominal model", 100 * loop.nominal, "%"
            yield f"{name}: of the diagnosed one: {note}", 100 * loop.extended, "%"
            yield f"{name}: error reduction", 100 * loop.error_reduction, "%"
            if loop.nominal > ERROR_MIN:
                reductions.append(loop.error_reduction)
    yield f"height errors above {ERROR_MIN:.1%}", len(reductions), "1"
    yield "of them, those that fell by 80 % or more", sum(reduction >= 0.8 for reduction in reductions), "1"
