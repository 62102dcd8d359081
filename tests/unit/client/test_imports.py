"""Modules that importing the client loads."""

import subprocess
import sys

import pytest

HEAVY = ("numba", "fastapi", "starlette", "uvicorn", "scipy", "h5py", "PIL")


MODULES = (
    "optodrive.client",
    "optodrive.client.display",
    "optodrive.client.async_display",
    "optodrive.client.cell_places",
    "optodrive.client.reader_port",
    "optodrive.daemon.responses.telemetry",
)


@pytest.mark.parametrize("module", MODULES)
def test_the_client_loads_no_server_and_no_compiler(module):
    code = f"import sys, {module}; print(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
