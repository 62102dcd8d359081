"""Commands whose caller has closed standard streams: nothing that is meant for them goes to another file."""

import os
import signal
import subprocess
from itertools import product
from pathlib import Path

import pytest

from forked_process import OPTODRIVE
from rig import wait_for

STREAMS = {"stdin": "<&-", "stdout": ">&-", "stderr": "2>&-"}
COMBINATIONS = [
    names
    for closed in product([False, True], repeat=3)
    if (names := [name for name, is_closed in zip(STREAMS, closed, strict=True) if is_closed])
]


def close(names, command):
    """Return a shell command that runs a command with streams closed."""
    return ["sh", "-c", " ".join(['exec "$@"', *(STREAMS[name] for name in names)]), "sh", OPTODRIVE, *command]


@pytest.mark.parametrize("names", COMBINATIONS, ids="-".join)
def test_commands_keep_their_status_and_their_other_streams(names):
    done = subprocess.run(close(names, ["config", "check"]), capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout == ("" if "stdout" in names else "display-437: 437 pixels, configuration valid\n")
    assert done.stderr == ""
    refused = subprocess.run(close(names, ["config", "check", "--config", "none.toml"]), capture_output=True, text=True)
    assert refused.returncode == 2
    assert refused.stdout == ""
    assert refused.stderr.count("\n") == ("stderr" not in names)


def test_the_daemon_starts_without_standard_streams(tmp_path):
    """No file of it, port or socket, has the number of one; the first three are /dev/null."""
    environment = os.environ | {"XDG_STATE_HOME": str(tmp_path), "XDG_RUNTIME_DIR": str(tmp_path)}
    with subprocess.Popen(close(STREAMS, ["serve", "--port", "0"]), env=environment) as daemon:
        try:
            children = Path(f"/proc/{daemon.pid}/task/{daemon.pid}/children")
            wait_for(lambda: len(children.read_text().split()) >= 4, "processes of the daemon")
            for pid in [str(daemon.pid), *children.read_text().split()]:
                for number in range(3):
                    assert Path(f"/proc/{pid}/fd/{number}").readlink() == Path(os.devnull)
        finally:
            daemon.send_signal(signal.SIGTERM)
    assert daemon.returncode == 0
