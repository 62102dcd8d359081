"""Look up the code and the tests that a page names, and the commands by which its figures were measured.

A page must not outlive what it describes.
"""

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
NAMED = re.compile(r"`([\w/]+\.(?:py|c)):([\w.]+)`")
NAMED_TEST = re.compile(r"`(test_\w+(?:\.py)?)`")
TEST_OF_FILE = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")
CODE = re.compile(r"`([^`\n]+)`|^(?: {4}|\$ )(.+)$", re.M)
"""Code within a sentence, and lines of commands."""
PATH = re.compile(r"(?<![\w./-])(?:tests|scripts|optodrive|firmware_protocol|configs)/[\w./-]*[\w-]")
PLACEHOLDER = re.compile(r"([A-Z]{4,}|/test_x)(\.py)?$")
SCRIPT = re.compile(r"(?<![\w./-])scripts/([\w-]+)(?![\w./-])((?: +[\w.:-]+)*)")
PYTEST = re.compile(r"\bpytest .*?(tests/[\w./]+\.py)")


def find_missing(markdown: str, root: Path = ROOT) -> list[str]:
    """Return the code that a page names and that does not exist.

    It consists of files, functions, classes, tests, benchmarks and options of scripts.
    """
    missing = [f"{file}:{name}" for file, name in NAMED.findall(markdown) if not _has(root, file, name)]
    missing += [name for name in NAMED_TEST.findall(markdown) if name not in _list_tests(root)]
    missing += [f"{file}::{name}" for file, name in TEST_OF_FILE.findall(markdown) if not _has_test(root, file, name)]
    for span, line in CODE.findall(markdown):
        missing += _find_missing_in_command((span or line).partition("#")[0].strip(), root)
    return missing


def _find_missing_in_command(text: str, root: Path) -> list[str]:
    """Return the paths, benchmarks, options and marks of a command that do not exist."""
    paths = [path for path in PATH.findall(text) if not PLACEHOLDER.search(path) and ":" not in text]
    missing = [path for path in paths if not (root / path).exists()]
    for name, rest in SCRIPT.findall(text):
        words = rest.split()
        if name == "bench" and words and not PLACEHOLDER.search(words[0]):
            name, words = f"bench_{words[0]}", [word for word in words[1:] if word != "--json"]
        sources = [path for path in (root / "scripts" / name, root / "scripts" / f"{name}.py") if path.is_file()]
        known = "".join(path.read_text(encoding="utf-8") for path in sources)
        if not sources and name.startswith("bench_"):
            missing.append(f"scripts/{name}.py")
        missing += [f"{name} {word}" for word in words if sources and word.startswith("--") and word not in known]
    if (test := PYTEST.search(text)) and (root / test[1]).is_file():
        source = (root / test[1]).read_text(encoding="utf-8")
        chosen = re.search(r"-k (\w+)", text)
        missing += [text] if " -m slow" in text and "mark.slow" not in source else []
        missing += [text] if chosen and chosen[1] not in source else []
    return missing


@cache
def _list_tests(root: Path) -> set[str]:
    names = set()
    for path in (root / "tests").rglob("test_*.py"):
        names |= {path.name, *re.findall(r"def (test_\w+)\(", path.read_text(encoding="utf-8"))}
    return names


def _has_test(root: Path, file: str, name: str) -> bool:
    path = root / file
    return path.is_file() and re.search(rf"\bdef {name}\(", path.read_text(encoding="utf-8")) is not None


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
