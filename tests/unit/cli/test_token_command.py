"""`optodrive token`: the changes in the file of tokens, and the destination of the secret."""

import json
import os
import pty
import stat
import subprocess
import sys

import pytest

from limited_files import largest_file
from optodrive.cli.main import run
from optodrive.daemon.api.tokens import read_private_tokens

TEXT = """# tokens of the laboratory
format = "optodrive-tokens"
version = 1

# the senior

# another comment
[[token]]
name = "anna" # room 12
role = "armer"
secret = "a-secret-of-anna"

# the junior
[[token]]
name = "ben"
role = "viewer"
secret = "a-secret-of-ben-too"
"""


@pytest.fixture(name="path")
def write_tokens(tmp_path):
    path = tmp_path / "tokens.toml"
    path.write_text(TEXT)
    path.chmod(0o600)
    return path


def roles(path):
    return {token.name: token.role for token in read_private_tokens(path).all}


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_add_appends_and_writes_the_secret_to_a_private_file_only(path, tmp_path, capfd):
    out = tmp_path / "cara.toml"
    assert run(["token", "add", "cara", "--role", "operator", "--file", str(path), "--out", str(out)]) == 0
    assert path.read_text().startswith(TEXT)
    assert roles(path) == {"anna": "armer", "ben": "viewer", "cara": "operator"}
    assert mode(path) == mode(out) == 0o600
    (token,) = read_private_tokens(out).all
    assert token in read_private_tokens(path).all
    said = "".join(capfd.readouterr())
    assert token.secret not in said
    assert "systemctl reload optodrive" in said
    assert sorted(tmp_path.iterdir()) == [out, path]


def test_a_pipe_gets_no_secret(path, capfd):
    for more in ([], ["--json"]):
        assert run(["token", "add", "cara", "--role", "viewer", "--file", str(path), *more]) == 2
        assert "a secret is shown on a terminal only" in capfd.readouterr().err
    assert path.read_text() == TEXT


def test_a_terminal_gets_the_secret_once(path):
    master, terminal = pty.openpty()
    command = [sys.executable, "-m", "optodrive.cli.main", "token", "add", "cara", "--role", "viewer", "--file", path]
    ended = subprocess.run(command, stdin=terminal, stdout=terminal, stderr=subprocess.PIPE, text=True, check=True)
    shown = os.read(master, 4096).decode().strip()
    os.close(master)
    os.close(terminal)
    assert read_private_tokens(path).all[-1].secret == shown
    assert shown not in ended.stderr


def test_a_new_file_is_private(tmp_path):
    path = tmp_path / "new.toml"
    assert run(["token", "add", "cara", "--role", "armer", "--file", str(path), "--out", str(tmp_path / "c")]) == 0
    assert roles(path) == {"cara": "armer"}
    assert mode(path) == 0o600


def test_revoke_removes_one_token_and_keeps_the_rest(path, capfd):
    assert run(["token", "revoke", "ben", "--file", str(path), "--json"]) == 0
    assert json.loads(capfd.readouterr().out) == {"name": "ben", "role": "viewer", "file": str(path)}
    assert path.read_text() == TEXT[: TEXT.index("\n# the junior")]
    assert mode(path) == 0o600
    assert run(["token", "revoke", "anna", "--file", str(path)]) == 2
    assert "must keep at least one" in capfd.readouterr().err
    assert roles(path) == {"anna": "armer"}


def test_list_shows_no_secret(path, capfd):
    assert run(["token", "list", "--file", str(path)]) == 0
    assert capfd.readouterr().out.split() == ["anna", "armer", "ben", "viewer"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["add", "anna", "--role", "viewer"], "NAME: got 'anna', expected a name that no token"),
        (["add", 'x"\n[y]', "--role", "viewer"], "expected 1 to 40 letters"),
        (["add", "cara", "--role", "admin"], "--role: got 'admin', expected a role, one of viewer, operator, armer\n"),
        (["add", "cara", "--role", "veiwer"], "--role: got 'veiwer', expected a role, nearest is 'viewer'\n"),
        (["revoke", "bem"], "nearest is 'ben'"),
    ],
)
def test_a_refusal_changes_nothing(path, tmp_path, capfd, arguments, says):
    out = ["--out", str(tmp_path / "holder.toml")] if arguments[0] == "add" else []
    assert run(["token", *arguments, "--file", str(path), *out]) == 2
    error = capfd.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert path.read_text() == TEXT
    assert sorted(tmp_path.iterdir()) == [path]


def test_a_table_that_cannot_be_told_apart_is_left_alone(path, capfd):
    path.write_text(
        'format = "optodrive-tokens"\nversion = 1\ntoken = [\n  {name = "a", role = "viewer", secret = '
        '"sixteen-letters-1"},\n  {name = "b", role = "viewer", secret = "sixteen-letters-2"}]\n'
    )
    before = path.read_text()
    assert run(["token", "revoke", "a", "--file", str(path)]) == 2
    assert "edit it by hand" in capfd.readouterr().err
    assert path.read_text() == before


def test_a_full_disk_leaves_no_part_of_a_file(path, tmp_path, capsys):
    command = ["token", "add", "cara", "--role", "viewer", "--file", str(path), "--out", str(tmp_path / "cara.toml")]
    with largest_file(20):
        assert run(command) == 2
    assert "cara.toml: got 'File too large'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [path]
    assert run(command) == 0


def test_a_file_of_which_no_token_may_arm_is_named(path, tmp_path, capfd):
    new = ["token", "add", "cara", "--role", "operator", "--file", str(tmp_path / "new.toml"), "--out"]
    assert run([*new, str(tmp_path / "cara.toml")]) == 0
    assert "no token of" in capfd.readouterr().err
    old = ["token", "add", "cara", "--role", "operator", "--file", str(path), "--out", str(tmp_path / "other.toml")]
    assert run(old) == 0
    assert "no token of" not in capfd.readouterr().err
