import sys
from functools import cache, partial
from pathlib import Path

import pytest

for folder in ("simulator", "protocol"):  # bench, checks and vectors of the Python tests
    sys.path.append(str(Path(__file__).parents[1] / "unit" / "link" / folder))

from c_board import CBench  # noqa: E402 - it stands on the bench

from c_core import build_library  # noqa: E402
from firmware_ports import build_emulated_chip  # noqa: E402


@pytest.fixture(scope="session")
def libraries(tmp_path_factory):
    """Return a function for the library of a mutant, 0 for the unmodified core; each is built once."""
    return cache(partial(build_library, tmp_path_factory.mktemp("core")))


@pytest.fixture(scope="session")
def library(libraries):
    return libraries(0)


@pytest.fixture(scope="session")
def chips(tmp_path_factory):
    """Return a function for the emulated chip of a mutant, 0 for the unmodified core; each is built once."""
    return cache(partial(build_emulated_chip, tmp_path_factory.mktemp("cortex-m3")))


@pytest.fixture
def make(library):
    return partial(CBench, library)
