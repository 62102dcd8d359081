from pathlib import Path

import pytest

from page_bench import Bench
from window import TIMEOUT_MS, PageVisit, launch_chromium


@pytest.fixture(scope="module")  # its event loop runs in this process: tests with their own loops run afterwards
def browser():
    with launch_chromium() as browser:
        from playwright.sync_api import expect

        expect.set_options(timeout=TIMEOUT_MS)
        yield browser


@pytest.fixture(scope="module")
def kept_bench(tmp_path_factory):
    bench = Bench(tmp_path_factory.mktemp("bench"))
    yield bench
    bench.stop()


@pytest.fixture
def bench(kept_bench):
    """One board and one daemon for all tests of a module, disarmed and without a fault before each test."""
    kept_bench.reset()
    return kept_bench


@pytest.fixture
def daemon(bench):
    return bench.daemon


@pytest.fixture(scope="module")
def kept_window(browser, kept_bench):
    window = PageVisit(browser, kept_bench.daemon.url, has_touch=True, reduced_motion="reduce")
    yield window
    window.context.close()


@pytest.fixture
def window(kept_window, bench):
    """One window for all tests of a module: a page that was just loaded, in a browser that remembers nothing."""
    kept_window.reset()
    return kept_window


@pytest.fixture
def page(window):
    return window.page


@pytest.fixture
def visit(browser, bench):
    """Return a function that opens a window of its own, for tests of a browser that was not here before."""
    visits = []

    def open_visit(**options):
        visits.append(PageVisit(browser, bench.daemon.url, **{"reduced_motion": "reduce"} | options))
        return visits[-1]

    yield open_visit
    for visit in visits:
        visit.context.close()


@pytest.fixture(scope="session")
def axe():
    return (Path(__file__).parent / "vendor" / "axe-core" / "axe.min.js").read_text(encoding="utf-8")
