"""`optodrive diagnose` for many pixels: distribute the pixels over processes and show the progress."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import TYPE_CHECKING

from optodrive.core.errors import InputError, Unquoted

if TYPE_CHECKING:
    from optodrive.device.config import Config
    from optodrive.lab.diagnosis.display_diagnosis import DisplayAnswer
    from optodrive.lab.recording import DisplayRuns

PROGRESS_LINES = 10
"""Number of progress lines where stderr is no terminal."""


def diagnose_display(
    runs: "DisplayRuns",
    seed: int,
    config: "Config | None",
    dask: str | None,
    workers: int | None,
    use: tuple[str, ...] = (),
) -> "DisplayAnswer":
    """Diagnose every pixel independently, on local processes or a cluster.

    Raises InputError where the diagnosis fails for every pixel.
    """
    from optodrive.core.types.measurements import MIRRORS
    from optodrive.lab.diagnosis.display_diagnosis import (
        DisplayAnswer,
        PixelAnswer,
        PixelTask,
        compile_kernels,
        diagnose_pixel,
        run_tasks,
    )

    start_s = perf_counter()
    tasks = [PixelTask(item.pixel, item.read, seed, config, use) for item in runs.pixels]
    if runs.mirrors is not None:
        tasks.append(PixelTask(MIRRORS, runs.mirrors.read, seed, config, use))
    if dask is None:
        compile_kernels()
    pixels: list[PixelAnswer] = []
    mirrors: PixelAnswer | None = None
    with _report_progress(len(runs.pixels)) as report_count:
        for task, result, error in run_tasks(diagnose_pixel, tasks, workers, dask):
            answer = result or PixelAnswer(task.pixel, None, error)
            if task.pixel == MIRRORS:
                mirrors = answer
            else:
                pixels.append(answer)
                report_count(len(pixels))
    pixels.sort(key=lambda item: item.pixel)
    if all(item.discrepancy is None for item in pixels):
        first = f"at least one; pixel {pixels[0].pixel}: {pixels[0].error}"
        raise InputError("diagnose", Unquoted(f"no answer for any of {len(pixels)} pixels"), first)
    return DisplayAnswer(tuple(pixels), mirrors, perf_counter() - start_s)


@contextmanager
def _report_progress(pixels: int) -> Iterator[Callable[[int], None]]:
    """Show a bar of diagnosed pixels on stderr, or a few lines where it is no terminal."""
    if not sys.stderr.isatty():
        steps = {pixels * (step + 1) // PROGRESS_LINES for step in range(PROGRESS_LINES)}

        def print_line(count: int) -> None:
            if pixels >= 2 * PROGRESS_LINES and count in steps:
                print(f"optodrive: {count} of {pixels} pixels", file=sys.stderr)

        yield print_line
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("pixels"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("pixels", total=pixels)
        yield lambda count: bar.update(task, completed=count)
