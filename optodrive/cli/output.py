"""Output that commands share: JSON, progress, and the notice of compilation."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def print_json(document: object) -> None:
    """Print one JSON object on stdout; it may be or contain Pydantic models."""
    json.dump(document, sys.stdout, indent=2, ensure_ascii=False, default=_convert_model)
    sys.stdout.write("\n")


def _convert_model(value: object) -> object:
    from pydantic_core import to_jsonable_python

    return to_jsonable_python(value)


def announce_compilation() -> None:
    """Announce on stderr that kernels are compiled, once the first is; count them where stderr is a terminal."""
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
    """Show a progress bar on stderr where it is a terminal; yield the callback, which takes the fraction 0 to 1."""
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
    """Show the current step and the elapsed time on stderr where it is a terminal; yield the callback."""
    if not sys.stderr.isatty():
        yield lambda step: None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(first_step, total=None)
        yield lambda step: bar.update(task, description=step)
