"""`optodrive calibrate pixels`: fit a pixel map to recordings of a sweep, or write the sweep to record."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.commissioning import confirm_emission
from optodrive.cli.options import ConfigOption, JsonOption, ModelOption, load_run_config
from optodrive.cli.output import announce_compilation, print_answer, print_json, show_progress
from optodrive.core.errors import MISSING, InputError
from optodrive.core.quantity import format_quantity, list_names

if TYPE_CHECKING:
    from optodrive.device.config import Config
    from optodrive.lab.calibration.pixel_sweep import Aim
if TYPE_CHECKING:
    from optodrive.lab.calibration.pixel_sweep import Aim
    from optodrive.lab.commissioning.sweep_player import AimPlan
    from optodrive.planning.display_model import DisplayModel


PULSE_FIELDS = ("pulse_width_s", "power_w")
README = "README.txt"


def write_sweep(folder: Path, config: str | None, json: bool) -> None:
    """Write the files of the sweep and a README, and print their summary.

    Raises InputError where a cell is too small for the offsets or the folder cannot be created.
    """
    from optodrive.core.files import check_output, write_text
    from optodrive.lab.calibration.pixel_sweep import compute_pulse

    check_output("--sweep", folder, folder=True)
    loaded, aims, counts = write_sweep_files(folder, config)
    write_text(folder / README, "\n".join(_format_instructions(aims, loaded.name)) + "\n")
    pulses = [dict(zip(PULSE_FIELDS, compute_pulse(loaded, aim), strict=True)) for aim in aims]
    described = [
        aim._asdict() | pulse | {"pulses": count} for aim, pulse, count in zip(aims, pulses, counts, strict=True)
    ]
    lines = [f"aims             {len(aims)}, one file per aim, {counts[0]} pulses per file"]
    if min(counts) < counts[0]:
        lines.append(f"out of range     up to {counts[0] - min(counts)} pixels per aim, which get no pulse there")
    lines += [
        f"{label:<17}{format_quantity(pulse['pulse_width_s'], 's')} at {format_quantity(pulse['power_w'], 'W')}"
        for pulse, label in zip(pulses[:2], ("centre", "across edges"), strict=True)
    ]
    lines.append(f"written          {folder}; {README} lists what to play and what to record")
    print_answer({"folder": str(folder), "aims": described, "pulses": counts[0]}, lines, json)


def write_sweep_files(folder: Path, config: str | None) -> "tuple[Config, list[Aim], list[int]]":
    """Write, for each aim, its pulses and the pixel map that offsets the beam by it.

    Returns the configuration, the aims, and for each the number of pixels that the mirrors' range contains.
    Raises InputError where a cell is too small for the offsets or the folder cannot be created.
    """
    from json import dumps

    from optodrive.core.files import create_folder, write_text
    from optodrive.core.types.stimuli import FrameSequence
    from optodrive.device.field_loader import load_scan_field
    from optodrive.device.pixel_map import remove_pixel_map, write_pixel_map
    from optodrive.lab.calibration.pixel_sweep import (
        build_aim_map,
        build_sweep,
        compute_pitch_min_m,
        is_reachable,
        list_aims,
    )
    from optodrive.planning.stimuli.sequence_file import sequence_to_json

    loaded = remove_pixel_map(load_run_config(config, None))
    aims = list_aims(loaded)
    pitch_min_m = compute_pitch_min_m(loaded, aims)
    if loaded.display.pitch_m < pitch_min_m:
        expected = f"at least {pitch_min_m:.6g}, so that the focus across an absorber's edge stays in the pixel's cell"
        with loaded.name_file():
            raise InputError("display.pitch_m", loaded.display.pitch_m, expected)
    create_folder(folder)
    with loaded.name_file():
        field = load_scan_field(loaded)
    reached = [is_reachable(loaded, field, aim) for aim in aims]
    for aim, pixels in zip(aims, reached, strict=True):
        text = dumps(sequence_to_json(FrameSequence((), build_sweep(loaded, aim, pixels)))) + "\n"
        write_text(folder / f"{aim.name}.json", text)
        about: dict[str, str | float | int] = {"source": f"sweep, aim {aim.name}"}
        write_pixel_map(folder / f"{aim.name}.pixels.toml", build_aim_map(aim, pixels), loaded, about)
    return loaded, aims, [int(pixels.sum()) for pixels in reached]


def _format_instructions(aims: "list[Aim]", display_name: str) -> list[str]:
    return [
        f"Play each file on {display_name} with its pixel map. The display must be cold before each file:",
        "",
        *(f"    {aim.name}.json with --pixel-map {aim.name}.pixels.toml" for aim in aims),
        "",
        "Record one run per pixel: the pulses; displacement_m with the pixel, from 20 ms before the pixel's pulse to",
        "100 ms after its end, at one sample per millisecond or faster; and the aim, as attributes of the run:",
        "",
        *(f"    {aim.name}: aim_x_m = {aim.x_m!r}, aim_y_m = {aim.y_m!r}" for aim in aims),
        "",
        "In all files but the first, part of the light misses the absorber: do not raise their power.",
    ]


REST_MAX_S = 3600.0
JOURNAL, RECORDING = "pulses.csv", "recording"


def sweep(
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="Folder of the journal and of the recording.")],
    rest_s: Annotated[
        float, typer.Option("--rest", metavar="SECONDS", help="Rest between aims, in which the display cools.")
    ] = 30.0,
    yes: Annotated[bool, typer.Option("--yes", help="Arm and emit without asking.")] = False,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Pulse every pixel at every aim under one arming, for `calibrate pixels`. It resumes after an interruption."""
    from optodrive.cli.commissioning import open_board
    from optodrive.core.files import check_output
    from optodrive.device.config_file import load_config
    from optodrive.lab.calibration.pixel_sweep import SweepJournal, build_runs, list_aims
    from optodrive.lab.commissioning.sweep_player import plan_aims, play_aims
    from optodrive.lab.recording import write_recording

    check_output("--out", out, folder=True, may_exist=True)
    if not 0.0 <= rest_s <= REST_MAX_S:
        raise InputError("--rest", rest_s, f"0 to {REST_MAX_S:g} s")
    if (out / RECORDING).exists():
        raise InputError("--out", str(out), f"a folder without {RECORDING}: this sweep is complete")
    loaded = load_config(config)
    aims = list_aims(loaded)
    confirm_emission(yes, f"this arms the board and pulses every pixel of {loaded.name} at {len(aims)} aims")
    displays, total = _build_displays(out, config, aims)
    journal = SweepJournal.open(out / JOURNAL, loaded.name)
    try:
        plans = plan_aims(displays, journal)
        if plans:
            with open_board(config, calibrated_field=True) as (board, _), show_progress("sweeping") as on_progress:

                def report(item: "AimPlan", count: int) -> None:
                    on_progress(len(journal.pulses) / total)
                    if not json and count == len(item.plan):
                        print(f"{item.aim.name:<17}{count} pulses", flush=True)

                board.connect()
                board.arm()
                play_aims(plans, board, journal, rest_s, report)
                board.disarm()
    finally:
        journal.close()
    journal.raise_if_failed()
    write_recording(
        out / RECORDING, build_runs(journal.pulses, aims, loaded.name, displays[0][1].ambient_k), "calibrate sweep"
    )
    document = {"recording": str(out / RECORDING), "journal": str(journal.path), "pulses": len(journal.pulses)}
    line = f"written          {out / RECORDING}: {len(journal.pulses)} runs, one per pixel and aim"
    print_answer(document, [line], json)


def _build_displays(out: Path, config: str | None, aims: "list[Aim]") -> "tuple[list[tuple[Aim, DisplayModel]], int]":
    """Write the files of the sweep, and load the display with the map of each aim.

    Return the number of pulses, too.
    """
    from optodrive.cli.options import load_run_config
    from optodrive.planning.display_model import DisplayModel

    counts = write_sweep_files(out, config)[2]
    displays = [
        (aim, DisplayModel.from_config(load_run_config(config, None, pixel_map=out / f"{aim.name}.pixels.toml")))
        for aim in aims
    ]
    return displays, sum(counts)


PIXELS_LISTED_MAX = 20


def pixels(
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(metavar="RECORDING", help="Recordings of the displacements under a sweep."),
    ] = None,
    sweep: Annotated[
        Path | None,
        typer.Option("--sweep", metavar="FOLDER", help="Write the files of the sweep to record, instead of a fit."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="pixels.toml", help="Write the pixel map.")] = None,
    model: ModelOption = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Fit the gain and aim offset of every pixel to recordings of a sweep, or write that sweep with --sweep."""
    if sweep is None:
        if not recordings:
            raise InputError("RECORDING", MISSING, "at least one recording of a sweep, or --sweep FOLDER")
        fit_pixel_map(recordings, out, config, model, json)
        return
    for name, value in (("RECORDING", recordings[0] if recordings else None), ("--out", out), ("--model", model)):
        if value is not None:
            raise InputError(name, str(value), "no such argument together with --sweep")
    write_sweep(sweep, config, json)


def fit_pixel_map(recordings: list[Path], out: Path | None, config: str | None, model: Path | None, json: bool) -> None:
    """Fit the gain and offset of every pixel, write pixels.toml where requested, and print the statistics."""
    from optodrive.core.extras import import_extra
    from optodrive.core.files import check_output

    import_extra("scipy")
    from optodrive.device.calibrated_field import strip_toml_specials
    from optodrive.device.pixel_map import remove_pixel_map, write_pixel_map
    from optodrive.lab.calibration.pixel_map_fit import PixelMapFitter, compute_stats
    from optodrive.lab.diagnosis.recording_checks import check_recording_units
    from optodrive.lab.recording import read_recording
    from optodrive.physics.parameters import load_parameters
    from optodrive.physics.thermal_state import build_cold_state

    check_output("--out", out, ".toml")
    # Gains are relative to the model without a map, also where the configuration names one.
    loaded = remove_pixel_map(load_run_config(config, model))
    parameters = load_parameters(loaded.pixel_model.parameters)
    reference = parameters.build_pixel(loaded.display.bridge_width_m)
    announce_compilation()
    fitter = PixelMapFitter(loaded, build_cold_state(loaded, parameters).simulate_displacement_m)
    with show_progress("reading") as on_progress:
        for index, recording in enumerate(recordings):
            measurement = read_recording(recording)
            check_recording_units(measurement, reference, str(recording))
            for run in measurement.runs:
                fitter.add_run(str(recording), run)
            on_progress((index + 1) / len(recordings))
    source = str(recordings[0]) if len(recordings) == 1 else f"{recordings[0]} and {len(recordings) - 1} more"
    pixel_map = fitter.fit(source, parameters.name)
    stats = compute_stats(pixel_map, fitter.run_count)
    if out is not None:
        metadata = {"source": strip_toml_specials(source), "runs": fitter.run_count, "measured": stats["measured"]}
        write_pixel_map(out, pixel_map, loaded, metadata)
    if json:
        print_json(stats | ({} if out is None else {"pixel_map": str(out)}))
        return
    _print_stats(stats)
    if out is not None:
        print(f"written          {out}")


def _print_stats(stats: dict[str, Any]) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    print(f"pixels           {stats['measured']} of {stats['pixels']} measured, in {stats['runs']} runs")
    print(f"dead             {_join_indices(stats['dead'])}")
    print(f"not measured     {_join_indices(stats['not_measured'])}")
    table = Table("", "median", "range", "sigma", box=SIMPLE)
    gain = stats["gain"]
    if gain is not None:
        gain_range = f"{gain['min']:.3f} (pixel {gain['min_pixel']}) to {gain['max']:.3f} (pixel {gain['max_pixel']})"
        table.add_row("gain", f"{gain['median']:.3f}", gain_range, f"{gain['sigma_median']:.4f}")
    for axis, offset in stats["offset_um"].items():
        if offset is None:
            table.add_row(f"offset {axis}", "not measured", "needs aims across both edges of the absorber", "")
        else:
            farthest = f"{offset['farthest']:+.1f} µm (pixel {offset['farthest_pixel']})"
            sigma = f"{offset['sigma_median']:.1f} µm"
            table.add_row(f"offset {axis}", f"{offset['median']:+.1f} µm", farthest, sigma)
    Console(width=100, highlight=False).print(table)


def _join_indices(indices: list[int]) -> str:
    return f"{len(indices)}: {list_names(indices, PIXELS_LISTED_MAX)}" if indices else "none"
