"""Shared fixtures and options of pytest, profiles of hypothesis, and the order of the tests."""

import gc
import os
import platform
import signal
import tempfile
from pathlib import Path

import certifi
import pytest
from hypothesis import HealthCheck, settings

# Before numpy is imported, also for the workers of xdist: a second thread of BLAS takes the time of the other worker.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if platform.machine() == "x86_64":  # one kernel for all processors: others round sums in another order
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")

import forked_probe
import forked_process
from displays import DISPLAYS
from pieces import take_piece

# Before any folder imports them: their assertions then explain themselves, whichever folder is collected first.
pytest.register_assert_rewrite(
    *(f"{name}_scenarios" for name in ("edge", "guard", "job", "link", "order", "self", "trigger", "trust"))
)

settings.register_profile(
    "thorough", deadline=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)
settings.register_profile("every run", settings.get_profile("thorough"), max_examples=25)


def pytest_configure(config):
    settings.load_profile("every run" if config.getoption("markexpr") == "not slow" else "thorough")
    shorten_certificates(config)


def shorten_certificates(config):
    """Let clients of HTTP load one certificate: each loads all of them, 30 ms, also for http on the loopback."""
    folder = tempfile.TemporaryDirectory()
    config.add_cleanup(folder.cleanup)
    first, end, _ = certifi.contents().partition("-----END CERTIFICATE-----\n")
    path = Path(folder.name) / "certificate.pem"
    path.write_text(first + end)
    os.environ["SSL_CERT_FILE"] = str(path)


def pytest_sessionstart():
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # of a job in the background; commands would inherit it
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish():
    forked_process.enable()  # in the environment that all tests share: OpenCV has changed it, no test has yet
    forked_probe.enable()
    gc.collect()
    gc.freeze()  # what was imported and collected lives to the end; each collection would visit it again


def pytest_sessionfinish():
    forked_process.disable()
    forked_probe.disable()


def pytest_addoption(parser):
    parser.addoption("--board", default=None, metavar="PORT", help="run the hardware tests on the board at PORT")
    parser.addoption("--piece", default="1/1", metavar="K/N", help="run the K-th of N pieces of the selected tests")


SLOW = (
    *("test_pico_daemon.py", "test_processes.py", "test_stop_and_states.py", "test_safe_exits.py", "test_page.py"),
    "test_plans_and_roles.py",
    *("test_link_process.py", "test_conformance_pty.py", "test_firmware_board.py", "test_home.py", "test_service.py"),
    *("test_security.py", "test_calibrate_loop.py", "test_telemetry.py", "test_openapi_document.py", "test_engine.py"),
    *("test_demo.py", "test_link_faults_virtual.py", "blind", "test_fuzz.py", "test_model.py", "test_recording.py"),
    *("test_diagnosis.py", "test_validation_study.py", "accuracy", "property", "firmware"),
)
"""Files and folders that take longest, in the order of their start: a worker with the last one keeps none waiting."""


NIGHTLY = tuple(line.partition(",")[0] for line in (Path(__file__).parent / "nightly.csv").read_text().splitlines()[1:])
"""Beginnings of the names of tests that are slow; the table names the test of the gate that covers their faults."""


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(config, items):
    for item in items:
        if item.nodeid.startswith(NIGHTLY):
            item.add_marker(pytest.mark.slow)
    order = {name: number for number, name in enumerate(SLOW)}
    items.sort(key=lambda item: min(order.get(name, len(SLOW)) for name in (item.path.name, item.path.parent.name)))
    if config.getoption("--board") is None:
        skip = pytest.mark.skip(reason="needs a real board: --board PORT")
        for item in items:
            if "hardware" in item.keywords:
                item.add_marker(skip)
    yield  # `-m` selects
    items[:] = take_piece(items, config.getoption("--piece"))


@pytest.fixture(params=sorted(DISPLAYS))
def any_display(request):
    return DISPLAYS[request.param]


@pytest.fixture
def display():
    return DISPLAYS["display-437"]
