"""The bounds of every file that is read: kind, size, depth, digits, keys. Refusals name file and line."""

import os
import re
from pathlib import Path

import pytest

from optodrive.core.errors import InputError
from optodrive.core.files import read_regular_file
from optodrive.core.toml_model import BYTES_MAX, DEPTH_MAX, read_toml

SPARSE_BYTES = 200_000_000


def make_pipe(path):
    os.mkfifo(path)


def make_sparse(path):
    with path.open("wb") as file:
        file.truncate(SPARSE_BYTES)


ENDLESS = {
    "a pipe": (make_pipe, "got a pipe, expected a regular file"),
    "a device": (lambda path: path.symlink_to("/dev/zero"), "got a device, expected a regular file"),
    "a terminal": (lambda path: path.symlink_to("/dev/tty"), "got a device, expected a regular file"),
    "a folder": (lambda path: path.mkdir(), "got a folder, expected a regular file"),
    "a large file": (make_sparse, f"got a larger file, expected at most {BYTES_MAX} bytes"),
    "a size that lies": (lambda path: path.symlink_to("/proc/kallsyms"), f"at most {BYTES_MAX} bytes"),
    "a loop": (lambda path: path.symlink_to(path), "expected a readable file"),
    "nothing": (lambda path: None, "got 'No such file or directory', expected a readable file"),
}


@pytest.mark.parametrize("kind", ENDLESS)
def test_only_regular_files_of_bounded_size_are_read(kind, tmp_path):
    make, message = ENDLESS[kind]
    path = tmp_path / "file.toml"
    make(path)
    with pytest.raises(InputError, match=re.escape(str(path)) + ".*" + message):
        read_toml(path)


def test_a_path_with_a_null_character_is_refused_in_one_line():
    with pytest.raises(InputError, match=r"^a\\x00b: .*expected the path of a file$"):
        read_regular_file(Path("a\0b"), 1)


CASES = {
    "a value too many": ("rows = 4\n\ncolumns = 4 4\n", ", line 3, column 13: got Expected newline or end of document"),
    "an open list": ("a = [1,", ", end of document: got Invalid value"),
    "an open table": ("[display\n", ", line 1, column 9: got Expected"),
    "an open string": ('a = 1\nb = "x\n', ", line 2, column 7: got Illegal character"),
    "no UTF-8": (b"a = 1\nb = '\xff'\n", r", line 2: got b'\\xff', expected TOML in UTF-8"),
    "digits": (f"a = {'1' * 5000}", "got an integer of more digits, expected integers of 64 bits"),
    "65 bits": (f"a = {2**64}", "got an integer of more digits, expected integers of 64 bits"),
    "65 bits with a sign": (f"a = {-(2**63) - 1}", "got an integer of more digits, expected integers of 64 bits"),
    "hexadecimal digits": (f"a = {{ b = [0x{'f' * 5000}] }}", r"a\.b\[0\]: got an integer of more digits"),
    "lists": (f"a = {'[' * 5000}", "got deeper nesting"),
    "deep lists": ("a = " + "[" * DEPTH_MAX + "]" * DEPTH_MAX, "got deeper nesting"),
    "deep tables": ("a = " + "{ a = " * DEPTH_MAX + "1" + "}" * DEPTH_MAX, "got deeper nesting"),
    "a dotted key": ("b = 1\n" + ".".join("a" * 5000) + " = 1", ", line 2: got deeper nesting"),
    "a dotted table": (f"[{' . '.join(['x', chr(34) + 'y' + chr(34)] * 500)}]", ", line 1: got deeper nesting"),
    "a long key": (f"{'k' * 5000} = 1", "a key: got 'kkk.*printable characters"),
    "a key of several lines": ('"a\\n\\u001bb" = 1', r"a key: got 'a\\n\\x1bb', expected"),
    "a word": ("a = serial", "valid TOML: .*text in quotation marks"),
    "a path": ("a = /dev/ttyACM0", "valid TOML: .*text in quotation marks"),
    "a unit": ("a = 3 mm", "valid TOML: a number .*without unit"),
    "a decimal comma": ("a = 0,003", "valid TOML: a number with a decimal point"),
    "a capital": ("a = True", "valid TOML: .*, true, false"),
    "a key twice": ("a = 1\na = 2\nb = 3", ", line 2, column 6: .*valid TOML: each key once"),
    "a section twice": ("[a]\n[a]\n", ", line 2, column 3: .*valid TOML: each section once"),
    "a date": ("a = 2026-13-45T25:00:00Z", "valid TOML"),
}


@pytest.mark.parametrize("case", CASES)
def test_refusals_are_one_line_with_the_file_and_the_place(case, tmp_path):
    content, message = CASES[case]
    path = tmp_path / "file.toml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=re.escape(str(path)) + ".*" + message) as refused:
        read_toml(path)
    assert str(refused.value).isprintable()


def test_files_within_the_bounds_are_read(tmp_path):
    path = tmp_path / "file.toml"
    depth = DEPTH_MAX - 1
    secret = ".".join("a" * 100)
    path.write_text(f"\ufeffa = {'[' * depth}{2**64 - 1}{']' * depth}\nsecret = '{secret}'\n", encoding="utf-8")
    table = read_toml(path)
    assert table["secret"] == secret
    assert str(table["a"]).strip("[]") == str(2**64 - 1)


def test_a_pipe_that_takes_the_name_before_it_is_opened_is_not_waited_for(tmp_path, monkeypatch):
    path, pipe = tmp_path / "file.toml", tmp_path / "pipe"
    path.write_text("a = 1\n")
    os.mkfifo(pipe)
    open_file = os.open

    def swap_and_open(name, flags):
        pipe.rename(path)
        return open_file(name, flags)

    monkeypatch.setattr(os, "open", swap_and_open)
    with pytest.raises(InputError, match="got a pipe"):
        read_toml(path)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o777])
def test_a_private_file_is_refused_by_the_mode_of_what_was_opened(mode, tmp_path):
    path = tmp_path / "file.toml"
    path.write_text("a = 1\n")
    path.chmod(0o600)
    assert read_toml(path, private=True) == {"a": 1}
    path.chmod(mode)
    with pytest.raises(InputError, match=f"mode {mode:04o}"):
        read_toml(path, private=True)
