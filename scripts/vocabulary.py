"""Check names and prose against scripts/retired_names.toml: docs/glossary.md has the names in their place.

Three rules: no retired word in an identifier or a public key, no retired phrase in any text, and one plain sentence as
the first line of every docstring.
"""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
RETIRED_NAMES = ROOT / "scripts" / "retired_names.toml"
CODE = ("optodrive", "firmware_protocol", "configs", "scripts", "tests")
DOCUMENTS = ("docs", "README.md", "CONTRIBUTING.md", "CHANGELOG.md")
WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
TEXT = (".py", ".c", ".h", ".js", ".css", ".html", ".md", ".toml", ".pml", ".service")
VAGUE = re.compile(r";|\b(what|whoever|whatever)\b", re.IGNORECASE)
C_NOISE = re.compile(
    r'/\*.*?\*/|//[^\n]*|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\'|^\s*#\s*include[^\n]*', re.S | re.M
)
C_NAME = re.compile(r"\b[A-Za-z_]\w*\b")
KEY = re.compile(r"[A-Za-z_]\w*")


class Name(NamedTuple):
    """An identifier or key as it stands in a file."""

    text: str
    path: str
    line: int
    is_function: bool = False


class Retired(NamedTuple):
    """The retired names: whole identifiers, functions, and sequences of words."""

    exact: frozenset[str]
    functions: frozenset[str]
    phrases: tuple[tuple[str, ...], ...]

    def find(self, name: Name) -> str | None:
        """Return the entry that forbids a name, None where it is allowed."""
        bare = name.text.lstrip("_")
        if bare in self.exact:
            return bare
        if name.is_function and bare in self.functions:
            return f"{bare}()"
        words = split_words(bare)
        for phrase in self.phrases:
            size = len(phrase)
            if any(words[start : start + size] == phrase for start in range(len(words) - size + 1)):
                return "_".join(phrase)
        return None


def load_phrases(text: str) -> re.Pattern[str]:
    """Return a pattern for the phrases of the table [phrases]."""
    phrases = [phrase for listed in tomllib.loads(text)["phrases"].values() for phrase in listed]
    # A single word also matches its inflections; the last word of a phrase must end.
    alternatives = "|".join(
        r"\s+".join(map(re.escape, phrase.split())) + (r"\b" if " " in phrase else "") for phrase in phrases
    )
    return re.compile(rf"\b(?:{alternatives})", re.IGNORECASE)


def find_phrases(path: str, source: str, phrases: re.Pattern[str]) -> Iterator[str]:
    """Yield one problem per retired phrase in a text."""
    for number, line in enumerate(source.splitlines(), 1):
        match = phrases.search(line)
        if match:
            yield f"{path}:{number}: {match[0]!r} (scripts/retired_names.toml retires the phrase)"


def find_vague_docstrings(path: str, source: str) -> Iterator[str]:
    """Yield a problem for each docstring of a file whose first line is not one plain sentence."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (ast.get_docstring(node) or "").splitlines()
            if lines and (not lines[0].endswith(".") or VAGUE.search(lines[0])):
                yield f"{path}:{node.body[0].lineno}: {lines[0]!r} is not one plain sentence"


def split_words(name: str) -> tuple[str, ...]:
    """Return the words of an identifier in lower case: LinkUp and link_up are the same."""
    return tuple(word.lower() for word in WORD.findall(name))


def load_retired(text: str) -> Retired:
    """Read the names of the table [names]."""
    entries = [entry for listed in tomllib.loads(text)["names"].values() for entry in listed]
    return Retired(
        frozenset(entry[1:] for entry in entries if entry.startswith("=")),
        frozenset(entry[:-2] for entry in entries if entry.endswith("()")),
        tuple(split_words(entry) for entry in entries if entry[0] != "=" and not entry.endswith("()")),
    )


def python_names(path: str, source: str) -> Iterator[Name]:
    """Yield the names that a Python file defines, its keyword arguments and its string keys."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            if not names_scenario(path, node.name):
                yield Name(node.name, path, node.lineno, is_function=True)
        elif isinstance(node, ast.ClassDef):
            yield Name(node.name, path, node.lineno)
        elif isinstance(node, ast.arg):
            yield Name(node.arg, path, node.lineno)
        elif isinstance(node, ast.keyword) and node.arg:
            yield Name(node.arg, path, node.value.lineno)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield Name(node.id, path, node.lineno)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield Name(node.attr, path, node.lineno)
        elif isinstance(node, ast.Dict):
            yield from (key_name(key, path) for key in node.keys if is_key(key))
        elif isinstance(node, ast.Subscript) and is_key(node.slice):
            yield key_name(node.slice, path)


def names_scenario(path: str, name: str) -> bool:
    """Return whether a function's name is the sentence that a test or a scenario shows."""
    return path.startswith("tests/") and (name.startswith("test_") or name.count("_") >= 4)


def is_key(node: ast.expr | None) -> bool:
    """Return whether a node is a string that could be a key of JSON or TOML."""
    return isinstance(node, ast.Constant) and isinstance(node.value, str) and KEY.fullmatch(node.value) is not None


def key_name(node: ast.expr | None, path: str) -> Name:
    """Return the key that a node holds. Only nodes that `is_key` accepts are permitted."""
    assert isinstance(node, ast.Constant)
    return Name(str(node.value), path, node.lineno)


def c_names(path: str, source: str) -> Iterator[Name]:
    """Yield every identifier of a C or JavaScript file, apart from its comments and strings."""
    blank = C_NOISE.sub(lambda match: "\n" * match[0].count("\n"), source)
    for number, line in enumerate(blank.splitlines(), 1):
        yield from (Name(name, path, number) for name in C_NAME.findall(line))


def toml_names(path: str, source: str) -> Iterator[Name]:
    """Yield the keys of a TOML file, those of tables included."""

    def walk(value: object) -> Iterator[str]:
        if isinstance(value, dict):
            for key, item in value.items():
                yield key
                yield from walk(item)
        elif isinstance(value, list):
            for item in value:
                yield from walk(item)

    yield from (Name(key, path, 0) for key in walk(tomllib.loads(source)))


READERS = {".py": python_names, ".c": c_names, ".h": c_names, ".js": c_names, ".toml": toml_names}


def tracked_files() -> list[str]:
    """Return the files under version control, without vendored ones."""
    command = ["git", "ls-files", *CODE, *DOCUMENTS]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [path for path in listed.splitlines() if "/vendor/" not in path and (ROOT / path).exists()]


def main() -> int:
    """Print every problem with its place. The exit status is 1 if there is one."""
    listed = RETIRED_NAMES.read_text(encoding="utf-8")
    retired, phrases = load_retired(listed), load_phrases(listed)
    verdicts: dict[tuple[str, bool], str | None] = {}
    problems = set()
    for path in tracked_files():
        suffix = Path(path).suffix
        if suffix not in TEXT:
            continue
        source = (ROOT / path).read_text(encoding="utf-8")
        if ROOT / path not in (RETIRED_NAMES, Path(__file__).resolve()):  # both spell the phrases out
            problems.update(find_phrases(path, source, phrases))
        if suffix == ".py" and path.startswith("optodrive/"):
            problems.update(find_vague_docstrings(path, source))
        for name in READERS[suffix](path, source) if suffix in READERS else ():
            key = (name.text, name.is_function)
            if key not in verdicts:
                verdicts[key] = retired.find(name)
            entry = verdicts[key]
            if entry is not None:
                problems.add(f"{name.path}:{name.line}: {name.text} (scripts/retired_names.toml retires {entry})")
    for problem in sorted(problems):
        print(problem)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
