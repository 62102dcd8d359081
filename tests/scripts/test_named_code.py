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
    (tests / "test_arming.py").write_text("def test_it_arms(board):\n    pass\n")
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
        ("tests/link", True),
        ("tests/link/test_gone.py", False),
    ],
)
def test_named_code_is_looked_up(root, named, is_there):
    assert find_missing(f"It begins (`{named}`) there.", root) == ([] if is_there else [named])


def test_other_code_spans_are_no_names(root):
    assert find_missing("`link/session.py`, `arm()`, `host:port` and `a.toml:3`", root) == []
