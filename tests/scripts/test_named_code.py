"""The check of named code finds the names on a page that the code lacks, and only those."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "scripts"))

from named_code import find_missing


@pytest.fixture
def root(tmp_path):
    package, firmware, tests = (tmp_path / name for name in ("optodrive/link", "firmware_protocol", "tests/link"))
    for folder in (package, firmware, tests):
        folder.mkdir(parents=True)
    (tests / "test_arming.py").write_text("@pytest.mark.slow\ndef test_it_arms(board):\n    pass\n")
    (tests / "test_stop.py").write_text("def test_it_stops(board):\n    pass\n")
    (tmp_path / "scripts").mkdir()
    (tmp_path / "scripts" / "load").write_text("exec python scripts/load.py")
    (tmp_path / "scripts" / "load.py").write_text('add_argument("--minutes")')
    (tmp_path / "scripts" / "bench").touch()
    (tmp_path / "scripts" / "bench_stop.py").write_text('OPTIONS = {"--only": {}}')
    (package / "session.py").write_text("class Session:\n    def arm(self): ...\n\n\nasync def run(): ...\n")
    (firmware / "core.c").write_text("bool arm(int a,\n         int b) {\n}\nstatic int disarm(void);\n")
    return tmp_path


@pytest.mark.parametrize(
    ("named", "is_there"),
    [
        ("link/session.py:Session", True),
        ("link/session.py:Session.arm", True),
        ("link/session.py:run", True),
        ("link/session.py:Session.run", False),
        ("link/session.py:disarm", False),
        ("link/gone.py:run", False),
        ("firmware_protocol/core.c:arm", True),
        ("firmware_protocol/core.c:disarm", False),  # declared, not defined
        ("test_it_arms", True),
        ("test_it", False),
        ("test_arming.py", True),
        ("test_gone.py", False),
        ("tests/link/test_arming.py::test_it_arms", True),
        ("tests/link/test_arming.py::test_it", False),
        ("tests/link/test_stop.py::test_it_arms", False),
        ("tests/link/test_gone.py::test_it_arms", False),
        ("tests/link", True),
        ("tests/link/test_gone.py", False),
    ],
)
def test_named_code_is_looked_up(root, named, is_there):
    assert find_missing(f"It begins (`{named}`) there.", root) == ([] if is_there else [named])


def test_other_code_spans_are_no_names(root):
    assert find_missing("`link/session.py`, `arm()`, `host:port` and `a.toml:3`", root) == []


@pytest.mark.parametrize(
    ("command", "missing"),
    [
        ("scripts/load --minutes 3", []),
        ("scripts/load --hours 3", ["load --hours"]),
        ("scripts/unload", ["scripts/unload"]),
        ("scripts/bench stop --only rest --json", []),
        ("scripts/bench gone", ["scripts/bench_gone.py"]),
        ("scripts/bench stop --seconds 3", ["bench_stop --seconds"]),
        ("scripts/bench NAME", []),
        ("pytest -m slow tests/link/test_arming.py", []),
        ("pytest -m slow -k it_arms tests/link/test_arming.py", []),
        ("pytest -k it_stops tests/link/test_arming.py", ["pytest -k it_stops tests/link/test_arming.py"]),
        ("pytest -m slow tests/link/test_stop.py", ["pytest -m slow tests/link/test_stop.py"]),
        ("pytest -s tests/link/test_gone.py", ["tests/link/test_gone.py"]),
        ("optodrive/link/NAME.py", []),
        ("/run/optodrive/optodrive.sock", []),
    ],
)
def test_the_command_of_a_figure_is_looked_up(root, command, missing):
    assert find_missing(f"It takes 3 s (`{command}`).", root) == missing
    assert find_missing(f"As measured:\n\n    {command}    # in 3 s\n", root) == missing
