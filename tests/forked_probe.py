"""The probe of HDF5 files as forks of a process that has loaded it.

A fresh interpreter per file spends a quarter of a second of processor time on imports. A test of another program than
the probe's own starts one all the same.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

from optodrive.lab.recording import hdf5

PROGRAM = hdf5._PROGRAM
_server = None


def serve():
    """Fork a probe per line of stdin: its arguments, and the file of its stderr. Answer with its exit code."""
    import h5py  # noqa: F401 - what a probe imports

    for line in sys.stdin:
        arguments, errors = json.loads(line)
        pid = os.fork()
        if pid == 0:
            os.dup2(os.open(errors, os.O_WRONLY), 2)
            sys.argv[1:] = arguments
            try:
                hdf5.main()
            except BaseException as error:
                os.write(2, f"{type(error).__name__}: {error}".encode())
                os._exit(1)
            os._exit(0)
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)


def run(command, **options):
    """Run a command as subprocess.run does, that of a probe as a fork."""
    global _server
    if command[3] != PROGRAM:
        return subprocess.run(command, **options)
    if _server is None:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        _server = subprocess.Popen([sys.executable, __file__], env=options["env"], text=True, **pipes)
    with tempfile.NamedTemporaryFile() as errors:
        _server.stdin.write(json.dumps((command[4:], errors.name)) + "\n")
        _server.stdin.flush()
        code = int(_server.stdout.readline())
        return subprocess.CompletedProcess(command, code, stderr=Path(errors.name).read_bytes())


def enable():
    """Let probes of this process be forks from now on."""
    hdf5.subprocess = SimpleNamespace(**vars(subprocess) | {"run": run})


def disable():
    if _server is not None:
        _server.stdin.close()
        _server.stdout.close()
        _server.wait()


if __name__ == "__main__":
    serve()
