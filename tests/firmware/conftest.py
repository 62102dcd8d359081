import sys
from functools import cache, partial
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
sys.path.insert(0, str(TESTS / "conformance"))  # the bench of its scenarios
sys.path.append(str(TESTS / "pico"))
sys.path.append(str(TESTS / "unit" / "link" / "protocol"))  # the vectors of the Python messages

from c_core import build_library  # noqa: E402
from firmware_ports import build_emulated_chip  # noqa: E402


@pytest.fixture(scope="session")
def libraries(tmp_path_factory):
    """Return a function for the library of a mutant, 0 for the unmodified core. Each is built once."""
    return cache(partial(build_library, tmp_path_factory.mktemp("core")))


@pytest.fixture(scope="session")
def library(libraries):
    return libraries(0)


@pytest.fixture(scope="session")
def chips(tmp_path_factory):
    """Return a function for the emulated chip of a mutant, 0 for the unmodified core. Each is built once."""
    return cache(partial(build_emulated_chip, tmp_path_factory.mktemp("cortex-m3")))
