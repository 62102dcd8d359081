"""`optodrive diagnose`: what a recording says of the model."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import ConfigOption, announce_compilation, print_json
from optodrive.core.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from optodrive.core.types.measurements import Measurement
    from optodrive.device.config import Config
    from optodrive.lab.recording import DisplayRuns

RecordingsArgument = Annotated[list[Path], typer.Argument(metavar="RECORDING…", help="HDF5 files or CSV folders.")]
STDOUT = "-"
DEFAULT_WIDTH_M = 0.4e-3
"""Where nobody says which bridge was measured: model.toml then holds for displays of that width only by R and C."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("diagnose")(diagnose)


@dataclass(frozen=True)
class _Told:
    """An answer in all its forms; model: None where there is none to write."""

    document: dict[str, Any]
    story: list[str]
    report: str
    model: str | None


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
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, help="Processes for a recording of many pixels; all cores without it."),
    ] = None,
    dask: Annotated[
        str | None, typer.Option("--dask", metavar="ADDRESS", help="A Dask scheduler for many pixels: tcp://host:8786.")
    ] = None,
) -> None:
    """Name what the simulation gets wrong in measured data, and what mending it gains."""
    _check_extra()
    from optodrive.device.config import load_config
    from optodrive.lab.diagnosis.display_diagnosis import TOGETHER
    from optodrive.lab.recording import DisplayRuns

    _check_targets(json, out)
    if dask is not None and workers is not None:
        raise InputError("--workers", workers, "no such option beside --dask: a cluster has its own workers")
    settings = None if config is None else load_config(config)
    runs = DisplayRuns.open(recordings)
    title = ", ".join(path.name for path in recordings)
    if len(runs.pixels) > TOGETHER:
        told = _each(runs, title, seed, settings, dask, workers)
    else:
        told = _together(recordings, title, seed, settings)
    _give(told, out, json)


def _together(recordings: list[Path], title: str, seed: int, config: "Config | None") -> _Told:
    """One pixel, or a few as one set of numbers."""
    from optodrive.lab.diagnosis.diagnose import diagnose as study
    from optodrive.lab.diagnosis.model_file import model_toml
    from optodrive.lab.diagnosis.narrative import answer, story
    from optodrive.lab.diagnosis.priors import prior_of
    from optodrive.lab.diagnosis.report import report

    measurement = _joined(recordings)
    prior, epsilon, width_m = prior_of(measurement, config)
    announce_compilation()
    with _ticking() as tick:
        found = study(measurement, seed, prior, epsilon, tick)
    model = model_toml(found, title, width_m or DEFAULT_WIDTH_M) if found.base else None
    return _Told(answer(found), story(found), report(found, title), model)


def _each(
    runs: "DisplayRuns", title: str, seed: int, config: "Config | None", dask: str | None, workers: int | None
) -> _Told:
    """Many pixels, each for itself."""
    from optodrive.cli.diagnose_display import diagnose_display
    from optodrive.lab.diagnosis.display_narrative import display_answer, display_story
    from optodrive.lab.diagnosis.display_report import display_report
    from optodrive.lab.diagnosis.model_file import model_toml

    announce_compilation()
    found = diagnose_display(runs, seed, config, dask, workers)
    middle, width_m, what = found.model()
    model = None if middle is None else model_toml(middle, title, width_m or DEFAULT_WIDTH_M, what)
    return _Told(display_answer(found), display_story(found), display_report(found, title, config), model)


def _give(told: _Told, out: Path | None, json: str | None) -> None:
    """Files, each whole, then words."""
    if json is not None and json != STDOUT:
        _write(Path(json), _text(told.document))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        _write(out / "report.html", told.report)
        _write(out / "diagnosis.json", _text(told.document))
        if told.model is not None:
            _write(out / "model.toml", told.model)
        else:  # one of an earlier answer would be taken for this one's
            (out / "model.toml").unlink(missing_ok=True)
    if json == STDOUT:
        print_json(told.document)
        return
    for line in told.story:
        print(line)
    if out is not None:
        print(f"written: {out}/report.html, diagnosis.json" + (", model.toml" if told.model is not None else ""))


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

    from optodrive.core.types.measurements import Measurement
    from optodrive.lab.recording import read_recording

    if len(paths) == 1:
        return read_recording(paths[0])
    runs = [replace(run, name=f"{path.stem}/{run.name}") for path in paths for run in read_recording(path).runs]
    return Measurement(tuple(runs))


def _text(document: dict[str, object]) -> str:
    import json

    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"


def _write(path: Path, text: str) -> None:
    from optodrive.core.files import written_whole

    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


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
