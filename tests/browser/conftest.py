from pathlib import Path

import pytest

from board_fixtures import board_disarmed, daemon_disarmed, disarmed, kept, make_board, make_daemon  # noqa: F401 - fixtures
from window import TIMEOUT_MS, PageVisit, launch_chromium


@pytest.fixture(scope="module")  # its event loop runs in this process: tests with their own loops run afterwards
def browser():
    with launch_chromium() as browser:
        from playwright.sync_api import expect

        expect.set_options(timeout=TIMEOUT_MS)
        yield browser


@pytest.fixture
def visit(browser):
    visits = []

    def open_visit(host, **options):
        visits.append(PageVisit(browser, host.url, **options))
        return visits[-1]

    yield open_visit
    for visit in visits:
        visit.context.close()


@pytest.fixture(scope="session")
def axe():
    return (Path(__file__).parent / "vendor" / "axe-core" / "axe.min.js").read_text(encoding="utf-8")
