"""Modules that importing the client loads."""

import subprocess
import sys

import pytest

HEAVY = ("numba", "fastapi", "starlette", "uvicorn", "scipy", "h5py", "PIL")


@pytest.mark.parametrize("module", ["optodrive.client", "optodrive.daemon.responses.telemetry"])
def test_the_client_loads_no_server_and_no_compiler(module):
    code = f"import sys, {module}; print(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
