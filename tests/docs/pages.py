"""Commands and Python examples of the documentation, as its pages print them."""

import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PROGRAMS = ("optodrive", "display/bin/optodrive", "/opt/optodrive/bin/optodrive")
COMMENT = re.compile(r"\s{2,}#.*$|^#.*$")


class Example(NamedTuple):
    """A command of a shell, or the code of a Python block; heading: the one above it; line: its number."""

    page: str
    heading: str
    line: int
    text: str
    is_python: bool

    @property
    def is_optodrive(self):
        """Whether it is a command of this program."""
        return not self.is_python and self.text.split()[0] in PROGRAMS

    @property
    def is_synopsis(self):
        """Whether it lists options in brackets instead of being a command."""
        return "[--" in self.text


def list_pages():
    """Return the pages that address users, README first."""
    docs = (path for path in sorted((ROOT / "docs").rglob("*.md")) if path.parent.name != "decisions")
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *docs]


@cache
def list_examples():
    """Return all commands and Python blocks of the pages."""
    return [example for path in list_pages() for example in read_examples(path)]


def read_examples(path):
    """Return the examples of a page: lines indented by four spaces that begin with a program, and Python blocks."""
    page, heading, found, lines = str(path.relative_to(ROOT)), "", [], path.read_text().splitlines()
    number, language = 0, None
    while number < len(lines):
        line, begin = lines[number], number + 1
        number += 1
        if line.startswith("```"):
            language = line[3:].strip() if language is None else None
            if language == "python":
                code = []
                while not lines[number].startswith("```"):
                    code.append(lines[number])
                    number += 1
                found.append(Example(page, heading, begin, "\n".join(code), True))
        elif line.startswith("#") and language is None:
            heading = line.lstrip("# ")
        elif language is None and line.startswith("    "):
            text = COMMENT.sub("", line.strip())
            while text.endswith("\\"):
                text = f"{text[:-1].rstrip()} {COMMENT.sub('', lines[number].strip())}"
                number += 1
            if is_command(text):
                found.append(Example(page, heading, begin, text, False))
    return found


SHELL = ("curl", "export", "make", "mkdocs", "pip", "python", "python3", "sudo", "systemctl", "openssl", "cp")
"""Programs of the shell with which a line of a block begins, besides this one."""


def is_command(text):
    """Return whether a line of an indented block is a command."""
    first = text.split()[0] if text else ""
    if re.fullmatch(r"[A-Z_]+=\S*", first):  # a variable for one command
        return True
    return first in PROGRAMS or first in SHELL or first.startswith(("scripts/", "/opt/optodrive/bin/"))
