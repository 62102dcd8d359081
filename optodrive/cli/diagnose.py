"""`optodrive diagnose`: what a recording says of the model."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.options import ConfigOption, announce_compilation, print_json
from optodrive.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from optodrive.flow import Discrepancy, Measurement

RecordingsArgument = Annotated[list[Path], typer.Argument(metavar="RECORDING…", help="HDF5 files or CSV folders.")]
STDOUT = "-"
DEFAULT_WIDTH_M = 0.4e-3
"""Where nobody says which bridge was measured: model.toml then holds for displays of that width only by R and C."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("diagnose")(diagnose)


def diagnose(
    recordings: RecordingsArgument,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Write report.html, diagnosis.json, model.toml.")
    ] = None,
    json: Annotated[
        str | None,
        typer.Option("--json", metavar="FILE", help="Write the answer as JSON; - for stdout and nothing else there."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the draws behind p values and intervals.")] = 0,
    config: ConfigOption = None,
) -> None:
    """Name what the simulation gets wrong in measured data, and what mending it gains."""
    _check_extra()
    from optodrive.analysis.prior import prior_of
    from optodrive.analysis.story import answer, story
    from optodrive.analysis.study import diagnose as study
    from optodrive.config import load_config

    _check_targets(json, out)
    measurement = _joined(recordings)
    prior, epsilon, width_m = prior_of(measurement, None if config is None else load_config(config))
    announce_compilation()
    with _ticking() as tick:
        found = study(measurement, seed, prior, epsilon, tick)
    document = answer(found)
    if json is not None and json != STDOUT:
        _write(Path(json), _text(document))
    if out is not None:
        _write_folder(out, found, recordings, width_m or DEFAULT_WIDTH_M)
    if json == STDOUT:
        print_json(document)
        return
    for line in story(found):
        print(line)
    if out is not None:
        print(f"written: {out}/report.html, diagnosis.json" + (", model.toml" if found.base else ""))


def _check_extra() -> None:
    from importlib.util import find_spec

    if find_spec("scipy") is None:
        raise InputError("scipy", None, "the extra: pip install 'optodrive[analysis]'", "missing_extra")


def _check_targets(json: str | None, out: Path | None) -> None:
    """Answers go beside recordings, never over one."""
    if json is not None and json != STDOUT and (Path(json).suffix in (".h5", ".hdf5") or Path(json).is_dir()):
        raise InputError("--json", json, "a file for the answer, or - for stdout")
    if out is not None and out.exists() and not out.is_dir():
        raise InputError("--out", str(out), "a folder")


def _joined(paths: list[Path]) -> "Measurement":
    from dataclasses import replace

    from optodrive.flow import Measurement
    from optodrive.recording import read_recording

    if len(paths) == 1:
        return read_recording(paths[0])
    runs = [replace(run, name=f"{path.stem}/{run.name}") for path in paths for run in read_recording(path).runs]
    return Measurement(tuple(runs))


def _text(document: dict[str, object]) -> str:
    import json

    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"


def _write(path: Path, text: str) -> None:
    from optodrive.files import written_whole

    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _write_folder(out: Path, found: "Discrepancy", recordings: list[Path], width_m: float) -> None:
    from optodrive.analysis.model_file import model_toml
    from optodrive.analysis.report import report
    from optodrive.analysis.story import answer

    title = ", ".join(path.name for path in recordings)
    out.mkdir(parents=True, exist_ok=True)
    _write(out / "report.html", report(found, title))
    _write(out / "diagnosis.json", _text(answer(found)))
    if found.base:
        _write(out / "model.toml", model_toml(found, title, width_m))


@contextmanager
def _ticking() -> "Iterator[Callable[[str], None]]":
    """What is being done, on stderr where that is a terminal."""
    import sys

    if not sys.stderr.isatty():
        yield lambda what: None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=None)
        yield lambda what: bar.update(task, description=what)
