"""Output that commands share: JSON, progress, and the notice of compilation."""

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple

TABLE_WIDTH_MAX = 500
"""Maximum width of a table, which otherwise fits its content, in characters."""


def print_json(document: object) -> None:
    """Print one JSON object on stdout. It may be or contain Pydantic models."""
    json.dump(document, sys.stdout, indent=2, ensure_ascii=False, default=_convert_model)
    sys.stdout.write("\n")


def print_answer(document: object, lines: Iterable[str], as_json: bool) -> None:
    """Print the answer of a command as one JSON object, or as lines of text."""
    if as_json:
        print_json(document)
        return
    for line in lines:
        print(line)


def list_written(path: Path | None) -> list[str]:
    """Return the line that names a written file, none without one."""
    return [] if path is None else [f"written          {path}"]


def print_table(headings: Sequence[str], rows: Iterable[Sequence[str]], numeric: frozenset[str] = frozenset()) -> None:
    """Print a table on stdout, not narrower than its content.

    numeric: headings of the columns aligned to the right
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in headings:
        table.add_column(heading, justify="right" if heading in numeric else "left", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(_escape(cell)) for cell in row))
    width = max(Console().width, Console(width=TABLE_WIDTH_MAX).measure(table).maximum)
    Console(width=width, highlight=False).print(table)


def _escape(text: str) -> str:
    """Return text without characters that act on a terminal."""
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode("ascii") for letter in text
    )


def _convert_model(value: object) -> object:
    from pydantic_core import to_jsonable_python

    return to_jsonable_python(value)


def announce_compilation() -> None:
    """Announce on stderr that kernels are compiled, once the first is. Count them where stderr is a terminal."""
    from optodrive.core.kernels import observe_compilation

    shown: Any = None

    def show_begin(count: int) -> None:
        nonlocal shown
        if count == 1:
            print("optodrive: compiling kernels, up to half a minute, once", file=sys.stderr)
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.status import Status

            shown = shown or Status("", console=Console(stderr=True))
            shown.update(f"compiling kernels: {count}")
            shown.start()

    def show_end() -> None:
        if shown is not None:
            shown.stop()

    observe_compilation(show_begin, show_end)


@contextmanager
def show_progress(label: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar on stderr where it is a terminal. Yield the callback, which takes the fraction 0 to 1."""
    if not sys.stderr.isatty():
        yield lambda fraction: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn(label), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=1.0)
        yield lambda fraction: bar.update(task, completed=fraction)


@contextmanager
def show_step(first_step: str) -> Iterator[Callable[[str], None]]:
    """Show the current step and the elapsed time on stderr where it is a terminal. Yield the callback."""
    if not sys.stderr.isatty():
        yield lambda step: None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(first_step, total=None)
        yield lambda step: bar.update(task, description=step)


FindingStatus = Literal["ok", "warning", "problem"]


class Finding(NamedTuple):
    """One check: its name, status, observation, and the remedy ('' where none is needed)."""

    check: str
    status: FindingStatus
    observation: str
    remedy: str = ""


def report_ok(check: str, observation: str) -> Finding:
    """Return a finding without a problem."""
    return Finding(check, "ok", observation)


def report_warning(check: str, observation: str, remedy: str) -> Finding:
    """Return a finding of a condition that can cause a failure."""
    return Finding(check, "warning", observation, remedy)


def report_problem(check: str, observation: str, remedy: str) -> Finding:
    """Return a finding of a condition that prevents operation."""
    return Finding(check, "problem", observation, remedy)
