"""`optodrive calibrate pixels`: fit a pixel map to recordings of a sweep, or write the sweep to record."""

from pathlib import Path
from typing import Annotated, Any

import typer

from optodrive.cli.calibrate.sweep import write_sweep
from optodrive.cli.options import ConfigOption, JsonOption, ModelOption, load_run_config
from optodrive.cli.output import announce_compilation, print_json, show_progress
from optodrive.core.errors import MISSING, InputError

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
    from optodrive.device.field_file import strip_toml_specials
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
    if not indices:
        return "none"
    omitted = len(indices) - PIXELS_LISTED_MAX
    more = f" and {omitted} more" if omitted > 0 else ""
    return f"{len(indices)}: {', '.join(map(str, indices[:PIXELS_LISTED_MAX]))}{more}"
