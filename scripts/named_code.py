"""Look up the code that a page names as `file:function`, and the tests. A page must not outlive what it describes."""

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
NAMED = re.compile(r"`([\w/]+\.(?:py|c)):([\w.]+)`")
NAMED_TEST = re.compile(r"`(test_\w+(?:\.py)?)`")
NAMED_PATH = re.compile(r"`(tests/[\w./-]+)`")


def find_missing(markdown: str, root: Path = ROOT) -> list[str]:
    """Return the code that a page names and that does not exist.

    It consists of files below optodrive/ or firmware_protocol/, functions, classes, tests and paths below tests/.
    """
    missing = [f"{file}:{name}" for file, name in NAMED.findall(markdown) if not _has(root, file, name)]
    missing += [name for name in NAMED_TEST.findall(markdown) if name not in _list_tests(root)]
    return missing + [path for path in NAMED_PATH.findall(markdown) if not (root / path).exists()]


@cache
def _list_tests(root: Path) -> set[str]:
    names = set()
    for path in (root / "tests").rglob("test_*.py"):
        names |= {path.name, *re.findall(r"def (test_\w+)\(", path.read_text(encoding="utf-8"))}
    return names


def _has(root: Path, file: str, name: str) -> bool:
    path = root / file if file.endswith(".c") else root / "optodrive" / file
    if not path.is_file():
        return False
    text = path.read_text(encoding="utf-8")
    if file.endswith(".c"):
        return re.search(rf"^[a-z][^;(]*\b{name}\([^;]*?\) \{{$", text, re.M) is not None
    scope: ast.AST = ast.parse(text)
    for part in name.split("."):
        kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
        found = [each for each in ast.walk(scope) if isinstance(each, kinds) and each.name == part]
        if not found:
            return False
        scope = found[0]
    return True
