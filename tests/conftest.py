"""Shared fixtures: displays of every shipped configuration, hypothesis without deadlines."""

import pytest
from hypothesis import HealthCheck, settings

from displays import DISPLAYS

settings.register_profile(
    "project", deadline=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)
settings.load_profile("project")


def pytest_addoption(parser):
    parser.addoption("--board", default=None, metavar="PORT", help="run the hardware tests on the board at PORT")


def pytest_collection_modifyitems(config, items):
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
