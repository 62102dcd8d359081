"""Progress of a calibration on the board, shown on stderr."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from optodrive.core.quantity import m_to_um

if TYPE_CHECKING:
    from optodrive.lab.commissioning.measurement_loop import MeasurementProgress


def print_status(message: str) -> None:
    """Print a line on stderr without buffering."""
    print(message, file=sys.stderr, flush=True)


@contextmanager
def show_measurement_progress(
    spots_max: int, target_rms_um: float, manual: bool
) -> "Iterator[Callable[[MeasurementProgress], None]]":
    """Show a bar with the error bound, or one line per spot where stderr is no terminal or prompts a person."""
    if manual or not sys.stderr.isatty():
        yield lambda progress: print_status(
            f"spot {progress.spots} of max {spots_max}: {_format_progress(progress, target_rms_um)}"
        )
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("spots"), BarColumn(), TextColumn("{task.completed:.0f} of {task.total:.0f}"))
    status_columns = (TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, *status_columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=spots_max)
        yield lambda progress: bar.update(
            task, completed=progress.spots, description=_format_progress(progress, target_rms_um)
        )


def _format_progress(progress: "MeasurementProgress", target_rms_um: float) -> str:
    outliers = f", {progress.outliers} outliers" if progress.outliers else ""
    return f"error bound {m_to_um(progress.error_bound_m):.1f} µm rms, target {target_rms_um:g} µm{outliers}"
