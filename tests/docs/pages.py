"""Commands and Python examples of the documentation, as its pages print them."""

import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PROGRAMS = ("optodrive", "display/bin/optodrive", "/opt/optodrive/bin/optodrive")
COMMENT = re.compile(r"\s{2,}#.*$|^#.*$")


class Example(NamedTuple):
    """A command of a shell, or the code of a Python block.

    heading: the one above it
    line: its number
    output: what the page shows that the command prints, None where it shows nothing
    """

    page: str
    heading: str
    line: int
    text: str
    is_python: bool
    output: str | None = None

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
    """Return the examples of a page: indented lines that begin with a program, and Python and console blocks."""
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
            elif language == "console":
                block = []
                while not lines[number].startswith("```"):
                    block.append((number + 1, lines[number]))
                    number += 1
                found += read_session(page, heading, block)
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


def read_output(page, beginning):
    """Return the output that a page shows of the command that begins so."""
    (shown,) = (e.output for e in list_examples() if e.page == page and e.output and e.text.startswith(beginning))
    return shown


def read_session(page, heading, block):
    """Return the examples of a console block: commands after "$ ", each with the lines below it as its output."""
    found = []
    for line, text in block:
        if text.startswith("$ "):
            found.append(Example(page, heading, line, COMMENT.sub("", text[2:]), False, ""))
        elif found and found[-1].text.endswith("\\"):
            command = f"{found[-1].text[:-1].rstrip()} {COMMENT.sub('', text.strip())}"
            found[-1] = found[-1]._replace(text=command)
        else:
            assert found, f"{page}:{line}: expected a command after '$ '"
            found[-1] = found[-1]._replace(output=f"{found[-1].output}{text}\n")
    return found


SHELL = ("curl", "export", "make", "mkdocs", "pip", "python", "python3", "sudo", "systemctl", "openssl", "cp")
"""Programs of the shell with which a line of a block begins, besides this one."""


def is_command(text):
    """Return whether a line of an indented block is a command."""
    first = text.split()[0] if text else ""
    if re.fullmatch(r"[A-Z_]+=\S*", first):  # a variable for one command
        return True
    return first in PROGRAMS or first in SHELL or first.startswith(("scripts/", "/opt/optodrive/bin/"))


class Block(NamedTuple):
    """An indented block, or a fenced one with its language."""

    page: str
    line: int
    language: str | None
    text: str


def list_blocks():
    """Return all blocks of the pages."""
    return [block for path in list_pages() for block in read_blocks(path)]


def read_blocks(path):
    """Return the blocks of a page: fenced ones, and lines indented by four spaces after an empty line."""
    page, blocks, lines = str(path.relative_to(ROOT)), [], path.read_text().splitlines()
    language, is_fenced, is_open, begin, kept = None, False, False, 0, []

    def close():
        if kept:
            blocks.append(Block(page, begin, language if is_fenced else None, "\n".join(kept).rstrip()))
        kept.clear()

    previous = ""
    for number, line in enumerate(lines, start=1):
        if line.startswith("```"):
            close()
            is_fenced, language, begin, is_open = not is_fenced, line[3:].strip(), number, False
        elif is_fenced:
            kept.append(line)
        elif line.startswith("    ") and (is_open or not previous.strip()):
            begin, is_open = (begin if is_open else number), True
            kept.append(line[4:])
        elif line.strip() or not is_open:
            close()
            is_open = False
        else:
            kept.append("")
        previous = line
    close()
    return blocks
