"""`optodrive diagnose`: find the errors of the model in a recording."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.diagnose_live import (
    DEFAULT_BUDGET_S,
    DEFAULT_OUT,
    RECORDING,
    LiveRequest,
    describe_campaign,
    describe_end,
    measure_live,
)
from optodrive.cli.options import ConfigOption
from optodrive.cli.output import announce_compilation, print_answer, show_step
from optodrive.cli.signals import end_as_interrupted
from optodrive.core.errors import MISSING, InputError
from optodrive.core.extras import import_extra

if TYPE_CHECKING:
    from optodrive.core.provenance import Provenance
    from optodrive.core.types.discrepancy import Discrepancy
    from optodrive.core.types.measurements import Measurement
    from optodrive.device.config import Config
    from optodrive.lab.pixel_discovery import PixelDiscovery
    from optodrive.lab.recording import DisplayRuns

RecordingsArgument = Annotated[
    list[Path] | None, typer.Argument(metavar="RECORDING", help="HDF5 files or CSV folders; none with --live.")
]
STDOUT = "-"
NAMELESS = ("none", "instrument", "unexplained")
"""Verdicts without a cause, whose model takes what a discovery found."""
DEFAULT_BRIDGE_WIDTH_M = 0.4e-3
"""Assumed where the recording states no width; R and C in model.toml then hold for displays of this width only."""


@dataclass(frozen=True)
class _DiagnosisOutput:
    """A diagnosis as JSON document, text, HTML and TOML. model_toml is None without a model to write."""

    document: dict[str, Any]
    narrative: list[str]
    report_html: str
    model_toml: str | None


def diagnose(
    context: typer.Context,
    recordings: RecordingsArgument = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Write report.html, diagnosis.json, model.toml.")
    ] = None,
    json: Annotated[
        str | None,
        typer.Option(
            "--json", metavar="FILE", help="Write the diagnosis as JSON; - writes it, and nothing else, to stdout."
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the sampling for p values and intervals.")] = 0,
    config: ConfigOption = None,
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, help="Processes for a recording of many pixels; default: all cores."),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            "--dask", metavar="ADDRESS", help="Dask scheduler for a recording of many pixels: tcp://host:8786."
        ),
    ] = None,
    live: Annotated[
        bool,
        typer.Option("--live", help="Measure on the board and its sensor; each diagnosis chooses the next experiment."),
    ] = False,
    budget_s: Annotated[
        float, typer.Option("--budget-s", metavar="SECONDS", help="Of --live: time in the laboratory.")
    ] = DEFAULT_BUDGET_S,
    yes: Annotated[bool, typer.Option("--yes", help="Of --live: arm and emit without asking.")] = False,
    discover: Annotated[
        bool, typer.Option("--discover", help="Seek a term that no catalogue holds, even where a cause is named.")
    ] = False,
    use: Annotated[
        list[str] | None,
        typer.Option(
            "--use",
            metavar="KIND",
            help="Use data that a finding of this kind leaves out: outlier, clipped, …; repeatable.",
        ),
    ] = None,
) -> None:
    """Name the errors of the model in measured data, and the gain from correcting them."""
    import_extra("scipy")
    if live:
        _refuse_with_live(recordings, workers, dask, discover, use)
        _check_json(json)
        _diagnose_live(context, LiveRequest(out or DEFAULT_OUT, budget_s, yes, seed, config), json)
        return
    if not recordings:
        raise InputError("RECORDING", MISSING, "a recording, or --live to measure one")
    from optodrive.device.config_file import load_config
    from optodrive.lab.diagnosis.display_diagnosis import MAX_JOINT_PIXELS
    from optodrive.lab.recording import DisplayRuns

    _check_output_paths(json, out)
    used = _check_use(use or [])
    if dask is not None and workers is not None:
        raise InputError("--workers", workers, "no such option together with --dask: a cluster has its own workers")
    settings = None if config is None else load_config(config)
    runs = DisplayRuns.open(recordings)
    names = [path.name for path in recordings]
    title, provenance = ", ".join(names), _capture_provenance(context, names, settings)
    with end_as_interrupted():
        if len(runs.pixels) > MAX_JOINT_PIXELS:
            if discover:
                expected = f"a recording of at most {MAX_JOINT_PIXELS} pixels; this one has {len(runs.pixels)}"
                raise InputError("--discover", True, expected)
            output = _diagnose_per_pixel(runs, title, seed, settings, dask, workers, provenance, used)
        else:
            output = _diagnose_jointly(recordings, out, title, seed, config, settings, provenance, discover, used)
        _write_output(output, out, json)


def _refuse_with_live(
    recordings: list[Path] | None, workers: int | None, dask: str | None, discover: bool, use: list[str] | None
) -> None:
    """Raise InputError for an argument that --live does not take."""
    given = {"RECORDING": recordings and str(recordings[0]), "--workers": workers, "--dask": dask}
    for name, value in (given | {"--discover": discover or None, "--use": use or None}).items():
        if value is not None:
            raise InputError(name, value, "nothing with --live, which measures one pixel itself")


def _diagnose_live(context: typer.Context, request: LiveRequest, json: str | None) -> None:
    """Measure and diagnose, and write recording and diagnosis into the folder."""
    from optodrive.device.config_file import load_config

    request.check()
    result = measure_live(request, quiet=json == STDOUT)
    recording = request.out / RECORDING
    settings = load_config(request.config)
    provenance = _capture_provenance(context, [str(recording)], settings)
    width_m = settings.display.bridge_width_m
    output = _build_output(
        result.diagnosis, str(recording), [str(recording)], provenance, request.out, request.config, width_m
    )
    output.document["campaign"] = describe_campaign(result)
    output.narrative[:0] = [describe_end(result), ""]
    _write_output(output, request.out, json)


def _capture_provenance(context: typer.Context, recordings: list[str], config: "Config | None") -> "Provenance":
    from json import dumps

    from optodrive.core.provenance import Provenance

    text = None if config is None else dumps(config.model_dump(mode="json"), sort_keys=True, ensure_ascii=False)
    return Provenance.capture(
        context.obj.arguments, recordings, None if config is None or text is None else (config.name, text)
    )


def _diagnose_jointly(
    recordings: list[Path],
    out: Path | None,
    title: str,
    seed: int,
    config_name: str | None,
    config: "Config | None",
    provenance: "Provenance",
    discovers: bool,
    use: tuple[str, ...],
) -> _DiagnosisOutput:
    """Diagnose one pixel, or a few pixels with common parameters, and seek a term where no known cause explains all."""
    from optodrive.lab.diagnosis.diagnose import diagnose as study
    from optodrive.lab.diagnosis.next_steps import OUT
    from optodrive.lab.diagnosis.nominal_fit import build_prior

    measurement, paths = _read_recordings(recordings), [str(path) for path in recordings]
    prior, width_m = build_prior(measurement, config)
    announce_compilation()
    with show_step("reading") as on_progress:
        diagnosis = study(measurement, seed, prior, on_progress, use=use)
        discovery = None
        if discovers or diagnosis.verdict == "unexplained":
            from optodrive.lab.diagnosis.detection import SearchLog
            from optodrive.lab.inspection.inspection import inspect_recording
            from optodrive.lab.pixel_discovery import discover_in_pixel

            log = SearchLog(omissions=diagnosis.omissions)
            step = "the search for a term that no catalogue holds"
            usable = inspect_recording(measurement, use).measurement
            discovery = log.attempt(step, discover_in_pixel, None, usable, prior, on_progress)
    return _build_output(diagnosis, title, paths, provenance, out or OUT, config_name, width_m, discovery)


def _build_output(
    diagnosis: "Discrepancy",
    title: str,
    paths: list[str],
    provenance: "Provenance",
    out: Path | str,
    config_name: str | None,
    width_m: float | None,
    discovery: "PixelDiscovery | None" = None,
) -> _DiagnosisOutput:
    from optodrive.core.document import Section
    from optodrive.lab.diagnosis.narrative import build_answer, build_model_toml, build_narrative
    from optodrive.lab.diagnosis.report import build_report
    from optodrive.lab.pixel_discovery import narrative
    from optodrive.lab.pixel_discovery.planned_terms import build_planned_terms
    from optodrive.physics.discovered_term import DiscoveredTerm

    document, lines, sections = None, list[str](), list[Section]()
    base, terms, discovered = diagnosis.base, diagnosis.terms, list[DiscoveredTerm]()
    if discovery is not None:
        document, lines = narrative.build_document(discovery), narrative.build_lines(discovery)
        if discovery.findings and diagnosis.verdict in NAMELESS:
            planned = build_planned_terms(discovery)
            base, terms, discovered = base | planned.base, {}, [*planned.terms]
            lines += narrative.build_planning_lines(planned, str(Path(out) / "model.toml"))
        sections = [narrative.build_section(discovery, lines)]
        lines = ["", *lines]
    width_m = width_m or DEFAULT_BRIDGE_WIDTH_M
    model = build_model_toml(base, terms, diagnosis.verdict, title, width_m, discovered=discovered) if base else None
    return _DiagnosisOutput(
        build_answer(diagnosis) | {"discovery": document, "provenance": provenance.to_dict()},
        build_narrative(diagnosis) + lines,
        build_report(diagnosis, title, provenance, paths, str(out), config_name, sections),
        model,
    )


def _diagnose_per_pixel(
    runs: "DisplayRuns",
    title: str,
    seed: int,
    config: "Config | None",
    dask: str | None,
    workers: int | None,
    provenance: "Provenance",
    use: tuple[str, ...],
) -> _DiagnosisOutput:
    """Diagnose many pixels independently."""
    from optodrive.cli.diagnose_display import diagnose_display
    from optodrive.lab.diagnosis.display_report import (
        build_display_answer,
        build_display_narrative,
        build_display_report,
    )
    from optodrive.lab.diagnosis.narrative import build_model_toml

    announce_compilation()
    diagnosis = diagnose_display(runs, seed, config, dask, workers, use)
    median_parameters, width_m, description = diagnosis.build_model()
    model = (
        None
        if median_parameters is None
        else build_model_toml(
            median_parameters.base,
            median_parameters.terms,
            median_parameters.verdict,
            title,
            width_m or DEFAULT_BRIDGE_WIDTH_M,
            description,
        )
    )
    return _DiagnosisOutput(
        build_display_answer(diagnosis) | {"provenance": provenance.to_dict()},
        build_display_narrative(diagnosis),
        build_display_report(diagnosis, title, config, provenance),
        model,
    )


def _write_output(output: _DiagnosisOutput, out: Path | None, json: str | None) -> None:
    """Write the requested files atomically, then print the narrative or the JSON document."""
    from optodrive.core.files import create_folder, write_text

    if json is not None and json != STDOUT:
        write_text(Path(json), _dump_json(output.document))
    if out is not None:
        create_folder(out)
        write_text(out / "report.html", output.report_html)
        write_text(out / "diagnosis.json", _dump_json(output.document))
        if output.model_toml is not None:
            write_text(out / "model.toml", output.model_toml)
    model = "" if output.model_toml is None else ", model.toml"
    written = [] if out is None else [f"written: {out}/report.html, diagnosis.json{model}"]
    print_answer(output.document, [*output.narrative, *written], json == STDOUT)


def _check_use(kinds: list[str]) -> tuple[str, ...]:
    from optodrive.core.errors import suggest_nearest
    from optodrive.lab.inspection.inspection import KINDS

    for kind in kinds:
        if kind not in KINDS:
            raise InputError("--use", kind, f"a kind of finding, {suggest_nearest(kind, list(KINDS))}")
    return tuple(kinds)


def _check_output_paths(json: str | None, out: Path | None) -> None:
    """Reject outputs that cannot be written, or that would overwrite anything."""
    from optodrive.core.files import check_output

    _check_json(json)
    check_output("--out", out, folder=True)


def _check_json(json: str | None) -> None:
    from optodrive.core.files import check_output

    if json is not None and json != STDOUT:
        check_output("--json", Path(json), ".json")


def _read_recordings(paths: list[Path]) -> "Measurement":
    from dataclasses import replace

    from optodrive.core.types.measurements import Measurement
    from optodrive.lab.recording import read_recording

    if len(paths) == 1:
        return read_recording(paths[0])
    twice = next((path for row, path in enumerate(paths) if path in paths[:row]), None)
    if twice is not None:
        raise InputError("RECORDING", str(twice), "every recording once")
    runs = [replace(run, name=f"{path.stem}/{run.name}") for path in paths for run in read_recording(path).runs]
    return Measurement(tuple(runs))


def _dump_json(document: dict[str, object]) -> str:
    import json

    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"
