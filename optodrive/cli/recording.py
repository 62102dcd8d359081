"""`optodrive recording convert | import | show | merge | trials`: convert, import, inspect and merge recordings."""

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import JsonOption
from optodrive.cli.output import list_written, print_answer, print_json, print_table
from optodrive.core.quantity import format_number, format_quantity

if TYPE_CHECKING:
    from optodrive.core.types.measurements import Measurement
    from optodrive.lab.recording.instrument_files import InstrumentFile
    from optodrive.lab.recording.trials import Trial

SessionArgument = Annotated[Path, typer.Argument(metavar="FILE", help="Output of `serve --record-session`.")]


def trials(
    session: SessionArgument,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="trials.csv", help="Write the table as CSV, a column per label.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """List the trials of a session: labels, requested and executed onset on three clocks, and outcome."""
    from optodrive.core.files import check_output, write_text
    from optodrive.lab.recording.trials import format_csv, read_trials

    check_output("--out", out, ".csv")
    found = read_trials(session)
    if out is not None:
        write_text(out, format_csv(found))
    if json:
        print_json(
            {"session": str(session), "trials": describe_trials(found), "written": None if out is None else str(out)}
        )
        return
    print_trials(found)
    if out is not None:
        print(f"written          {out}")


def describe_trials(found: list["Trial"]) -> list[dict[str, Any]]:
    """Return the trials as JSON values."""
    return [asdict(trial) for trial in found]


def print_trials(found: list["Trial"]) -> None:
    """Print a table with the executed onset in Unix time, and how much later it was than requested."""
    from optodrive.cli.output import print_table

    headings = ("plan", "name", "run", "status", "executed", "delay", "pulses", "labels", "error")
    print_table(headings, [_format_trial(trial) for trial in found], frozenset({"delay", "pulses"}))


def _format_trial(trial: "Trial") -> list[str]:
    from optodrive.core.quantity import format_quantity

    executed_s, unix_s = trial.executed["board_s"], trial.executed["unix_s"]
    requested_s = trial.requested["board_s"]
    at = "" if unix_s is None else f"{datetime.fromtimestamp(unix_s, UTC):%Y-%m-%d %H:%M:%S.%f}Z"
    delay = "" if executed_s is None or requested_s is None else format_quantity(executed_s - requested_s, "s")
    pulses = f"{trial.executed_pulses} of {trial.planned_pulses}"
    labels = ", ".join(f"{key}={value}" for key, value in trial.labels.items())
    return [trial.plan, trial.name, trial.run, trial.status, at, delay, pulses, labels, trial.error]


RecordingArgument = Annotated[Path, typer.Argument(metavar="RECORDING", help="An HDF5 file, or a folder of CSV files.")]
GROUP = typer.Typer(help="Inspect recordings, convert them, or merge them with a session.", no_args_is_help=True)


@GROUP.command()
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="An HDF5 file, or a folder of CSV files.")],
    target: Annotated[
        Path, typer.Argument(metavar="OUT", help="HDF5 if the name ends in .h5 or .hdf5, otherwise a new folder.")
    ],
    json: JsonOption = False,
) -> None:
    """Convert an HDF5 recording to a folder of CSV files or back, without loss of precision."""
    from optodrive.core.files import check_output
    from optodrive.lab.recording import convert_recording
    from optodrive.lab.recording.storage import HDF5_SUFFIXES

    check_output("OUT", target, *HDF5_SUFFIXES, folder=True)
    measurement = convert_recording(source, target)
    samples = sum(len(signal.t_s) for run in measurement.runs for signal in run.signals.values())
    lines = [f"runs             {len(measurement.runs)}", f"samples          {samples}", *list_written(target)]
    print_answer({"written": str(target), "runs": len(measurement.runs), "samples": samples}, lines, json)


@GROUP.command()
def show(
    recording: RecordingArgument,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="picture.png", help="Draw every signal in a picture.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Validate a recording, state its unusable data, and list the signals of each run."""
    from optodrive.core.errors import InputError
    from optodrive.core.files import check_output
    from optodrive.lab.inspection.inspection import inspect_recording
    from optodrive.lab.inspection.page import build_finding, build_lines
    from optodrive.lab.recording.reader import read_recording_or_session
    from optodrive.lab.recording.show import build_summary
    from optodrive.lab.recording.trials import read_trials_if_any

    check_output("--out", out, ".png")
    measurement, is_session = read_recording_or_session(recording)
    if is_session and out is not None:
        raise InputError("--out", str(out), "a recording with signals; this is a session, which has pulses alone")
    runs, found = build_summary(measurement), read_trials_if_any(recording)
    page = None if is_session else inspect_recording(measurement)
    plotted_runs = None if out is None else _draw_signals(out, measurement)
    if json:
        picture = None if out is None else {"file": str(out), "runs": plotted_runs}
        data = None if page is None else [build_finding(item) for item in page.findings]
        answer = {"recording": str(recording), "data": data, "runs": runs, "trials": describe_trials(found)}
        print_json(answer | {"picture": picture})
        return
    if page is not None:
        print("\n".join([*build_lines(page.findings, page.failures), ""]))
    headings = ("run", "group", "pulses", "energy", "signal", "pixel", "samples", "missing", "span")
    numbers = frozenset({"pulses", "energy", "pixel", "samples", "missing"})
    print_table(headings, [cells for run in runs for cells in _format_rows(run)], numbers)
    if found:
        print()
        print_trials(found)
    if is_session:
        print("a session of the daemon: pulses without signals; `recording merge` adds what was measured meanwhile")
    if out is not None:
        part = "" if plotted_runs == len(runs) else f", the first {plotted_runs} of {len(runs)} runs"
        print(f"written          {out}{part}")


@GROUP.command("import")
def import_files(
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="FILE...", help="Files to propose a map for."),
    ] = None,
    map_path: Annotated[
        Path | None, typer.Option("--map", metavar="map.toml", help="What the columns are; it names the files.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="OUT", help="With --map: HDF5 (.h5, .hdf5), or a folder.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Make a recording of files of oscilloscopes and loggers by a map, or propose a map."""
    from optodrive.core.errors import InputError, Unquoted
    from optodrive.core.files import check_output
    from optodrive.lab.recording.instrument_files import read_instrument_file
    from optodrive.lab.recording.storage import HDF5_SUFFIXES

    if map_path is None:
        if not files or out is not None:
            shown = Unquoted("--out without --map" if out is not None else "no file")
            raise InputError("FILE", shown, "files to propose a map for, or --map map.toml --out OUT")
        _propose_map([read_instrument_file(file) for file in files], json)
        return
    if files or out is None:
        shown = Unquoted("files beside --map" if files else "--map without --out")
        raise InputError("--map", shown, "--map map.toml --out OUT; the map names the files")
    check_output("--out", out, *HDF5_SUFFIXES, folder=True)
    _import_by_map(map_path, out, json)


def _propose_map(files: "list[InstrumentFile]", json: bool) -> None:
    from optodrive.lab.recording.import_map import propose_map

    text = propose_map(files)
    if json:
        print_json({"files": [_describe_file(file) for file in files], "map": text})
        return
    for file in files:
        _print_file(file, "# ")
    print(f"\n{text}", end="")


def _import_by_map(map_path: Path, out: Path, json: bool) -> None:
    from optodrive.lab.inspection.inspection import inspect_recording
    from optodrive.lab.inspection.page import build_finding, build_lines
    from optodrive.lab.recording import write_recording
    from optodrive.lab.recording.importing import import_recording

    measurement, files = import_recording(map_path)
    page = inspect_recording(measurement)
    write_recording(out, measurement, f"imported by {map_path.name}")
    if json:
        data = [build_finding(item) for item in page.findings]
        runs = [run.name for run in measurement.runs]
        answer = {"written": str(out), "files": [_describe_file(file) for file in files], "runs": runs, "data": data}
        print_json(answer)
        return
    for file in files:
        _print_file(file)
    print()
    rows = [
        [run.name, name, str(len(signal.t_s)), *(format_number(each, 5) for each in (signal.t_s[0], signal.value[0]))]
        for run in measurement.runs
        for name, signal in run.signals.items()
    ]
    print_table(("run", "signal", "samples", "first time, s", "first value"), rows, frozenset({"samples"}))
    print("\n".join(["", *build_lines(page.findings, page.failures), "", *list_written(out)]))
    if not any(len(run.pulses) for run in measurement.runs):
        print("no pulses: state pulses or [gate] in the map, or merge with a session by `optodrive recording merge`")


def _describe_file(file: "InstrumentFile") -> dict[str, Any]:
    columns = [
        {"column": column.key, "unit": column.unit, "samples": len(column.value), "first": column.value[:3].tolist()}
        for column in file.columns
    ]
    return {"file": str(file.path), "notes": list(file.notes), "columns": columns}


def _print_file(file: "InstrumentFile", prefix: str = "") -> None:
    """Print the notes and the columns of a file with their first values."""
    print(f"{prefix}{file.path}: {'; '.join(file.notes)}")
    for column in file.columns:
        first = ", ".join(format_number(value, 5) for value in column.value[:3])
        print(f"{prefix}  {column.key} [{column.unit or 'no unit'}]: {len(column.value)} samples: {first}, …")


@GROUP.command()
def merge(
    session: Annotated[Path, typer.Argument(metavar="SESSION.h5", help="Output of `serve --record-session`.")],
    measured: Annotated[Path, typer.Argument(metavar="MEASURED", help="A recording of the same runs, without pulses.")],
    out: Annotated[
        Path, typer.Option("--out", metavar="OUT", help="HDF5 if the name ends in .h5 or .hdf5, otherwise a folder.")
    ],
    time_offset_s: Annotated[
        float, typer.Option("--time-offset", metavar="SECONDS", help="Added to every measured time.")
    ] = 0.0,
    json: JsonOption = False,
) -> None:
    """Merge the executed pulses of a session with signals measured meanwhile into a recording for `diagnose`."""
    from optodrive.core.files import check_output
    from optodrive.lab.recording import write_recording
    from optodrive.lab.recording.reader import merge_session
    from optodrive.lab.recording.storage import HDF5_SUFFIXES

    check_output("--out", out, *HDF5_SUFFIXES, folder=True)
    measurement = merge_session(session, measured, time_offset_s)
    write_recording(out, measurement)
    pulses = sum(len(run.pulses) for run in measurement.runs)
    lines = [f"runs             {len(measurement.runs)}", f"pulses           {pulses}", *list_written(out)]
    print_answer({"written": str(out), "runs": len(measurement.runs), "pulses": pulses}, lines, json)


GROUP.command()(trials)


def _draw_signals(out: Path, measurement: "Measurement") -> int:
    from optodrive.lab.recording.show import write_plot

    return write_plot(out, measurement)


def _format_rows(run: dict[str, Any]) -> list[list[str]]:
    energy = "" if run["energy_J"] is None else format_quantity(run["energy_J"], "J", 4)
    first = [run["run"], " ".join((run["group"] or "").split()), str(run["pulses"]), energy]
    rows = [] if run["signals"] else [[*first, "none", "", "", "", ""]]
    for name, signal in run["signals"].items():
        span = f"{format_number(signal['start_s'], 4)} to {format_number(signal['end_s'], 4)} s"
        pixel = "" if name.startswith("mirror") else str(signal["pixel"])
        rows.append([*first, name, pixel, str(signal["samples"]), str(signal["missing"]), span])
        first = ["", "", "", ""]
    return rows
