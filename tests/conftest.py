"""Shared fixtures and options of pytest, profiles of hypothesis, and the order of the tests."""

import os

import pytest
from hypothesis import HealthCheck, settings

# Before numpy is imported, also for the workers of xdist: a second thread of BLAS takes the time of the other worker.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import forked_process
from displays import DISPLAYS

settings.register_profile(
    "thorough", deadline=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)
settings.register_profile("every run", settings.get_profile("thorough"), max_examples=40)


def pytest_configure(config):
    settings.load_profile("every run" if config.getoption("markexpr") == "not slow" else "thorough")


def pytest_sessionstart():
    forked_process.enable()


def pytest_sessionfinish():
    forked_process.disable()


def pytest_addoption(parser):
    parser.addoption("--board", default=None, metavar="PORT", help="run the hardware tests on the board at PORT")


SLOW_FOLDERS = ("blind", "property", "firmware", "servo", "calibration", "cli", "analysis", "conformance")
SLOW_FILES = ("test_calibrate_loop.py", "test_home.py", "test_safe_exits.py")
"""Slow folders and files, which run first: started last, one would occupy a worker while the others are idle."""


def pytest_collection_modifyitems(config, items):
    items.sort(key=lambda item: item.path.name not in SLOW_FILES and item.path.parent.name not in SLOW_FOLDERS)
    if config.getoption("--board") is None:
        skip = pytest.mark.skip(reason="needs a real board: --board PORT")
        for item in items:
            if "hardware" in item.keywords:
                item.add_marker(skip)


@pytest.fixture(params=sorted(DISPLAYS))
def any_display(request):
    return DISPLAYS[request.param]


@pytest.fixture
def display():
    return DISPLAYS["display-437"]
