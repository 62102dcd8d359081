"""`optodrive calibrate --pixels`: heights measured under a sweep to a map of the pixels; and the sweep itself."""

from pathlib import Path
from typing import Annotated, Any

import typer

from optodrive.cli.options import announce_compilation, load_run_config, print_json, show_progress
from optodrive.core.errors import InputError

PixelsOption = Annotated[
    list[Path] | None,
    typer.Option("--pixels", metavar="recording.h5", help="Measured: heights under a sweep; finds gains and offsets."),
]
MorePixelsArgument = Annotated[
    list[Path] | None, typer.Argument(metavar="[RECORDING]…", help="Further recordings of --pixels.")
]
SweepOption = Annotated[
    Path | None,
    typer.Option("--pixels-sweep", metavar="FOLDER", help="Write what is to be played and recorded for --pixels."),
]
LISTED_MAX = 20
PULSE_FIELDS = ("pulse_width_s", "power_w")
README = "README.txt"


def calibrate_pixels(
    recordings: list[Path], out: Path | None, config: str | None, model: Path | None, json: bool
) -> None:
    """Fit gains and offsets, write pixels.toml where asked, and say what was found."""
    from optodrive.device.field_file import strip_toml_specials
    from optodrive.device.pixel_map import remove_pixel_map, write_pixel_map
    from optodrive.lab.calibration.pixels.map_fit import PixelMapFitter, compute_stats
    from optodrive.lab.recording import read_recording
    from optodrive.physics.parameters import load_parameters
    from optodrive.physics.thermal_state import build_cold_state

    # Gains are against the bare model, whatever map is in use.
    loaded = remove_pixel_map(load_run_config(config, model))
    parameters = load_parameters(loaded.pixel_model.parameters)
    announce_compilation()
    responses = PixelMapFitter(loaded, build_cold_state(loaded, parameters).simulate_displacement_m)
    with show_progress("reading") as done:
        for number, recording in enumerate(recordings):
            for run in read_recording(recording).runs:
                responses.add_run(str(recording), run)
            done((number + 1) / len(recordings))
    source = str(recordings[0]) if len(recordings) == 1 else f"{recordings[0]} and {len(recordings) - 1} more"
    pixel_map = responses.fit(source, parameters.name)
    stats = compute_stats(pixel_map, responses.run_count)
    if out is not None:
        metadata = {"source": strip_toml_specials(source), "runs": responses.run_count, "measured": stats["measured"]}
        write_pixel_map(out, pixel_map, loaded, metadata)
    if json:
        print_json(stats | ({} if out is None else {"pixels_map": str(out)}))
        return
    _print_table(stats)
    if out is not None:
        print(f"written          {out}")


def _print_table(stats: dict[str, Any]) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    print(f"pixels           {stats['measured']} of {stats['pixels']} measured, in {stats['runs']} runs")
    print(f"dead             {_join_indices(stats['dead'])}")
    print(f"not measured     {_join_indices(stats['not_measured'])}")
    table = Table("", "median", "extremes", "one sigma", box=SIMPLE)
    gain = stats["gain"]
    if gain is not None:
        extremes = f"{gain['min']:.3f} (pixel {gain['min_pixel']}) to {gain['max']:.3f} (pixel {gain['max_pixel']})"
        table.add_row("gain", f"{gain['median']:.3f}", extremes, f"{gain['sigma_median']:.4f}")
    for axis, offset in stats["offset_um"].items():
        if offset is None:
            table.add_row(f"offset {axis}", "not measured", "aims on both sides of the absorber are needed", "")
        else:
            extremes = f"{offset['farthest']:+.1f} µm (pixel {offset['farthest_pixel']})"
            sigma = f"{offset['sigma_median']:.1f} µm"
            table.add_row(f"offset {axis}", f"{offset['median']:+.1f} µm", extremes, sigma)
    Console(width=100, highlight=False).print(table)


def _join_indices(pixels: list[int]) -> str:
    if not pixels:
        return "none"
    more = f" and {len(pixels) - LISTED_MAX} more" if len(pixels) > LISTED_MAX else ""
    return f"{len(pixels)}: {', '.join(map(str, pixels[:LISTED_MAX]))}{more}"


def write_sweep(folder: Path, config: str | None, json: bool) -> None:
    """One file to play an aim, the map that leads the beam there beside it, and a README."""
    from json import dumps

    from optodrive.core.files import atomic_write
    from optodrive.core.types.stimuli import FrameSequence
    from optodrive.device.config import build_pixel_layout
    from optodrive.device.pixel_map import PixelMap, max_aim_offset_m, remove_pixel_map, write_pixel_map
    from optodrive.lab.calibration.pixels.sweep import build_sweep, compute_pulse, list_aims
    from optodrive.planning.stimuli.sequence_file import sequence_to_json

    loaded = remove_pixel_map(load_run_config(config, None))
    offset_max_m, count = max_aim_offset_m(loaded), len(build_pixel_layout(loaded.display))
    sweep_aims = list_aims(loaded)
    for aim in sweep_aims:
        if abs(aim.x_m) > offset_max_m[0] or abs(aim.y_m) > offset_max_m[1]:
            expected = f"cells that hold the focus {max(abs(aim.x_m), abs(aim.y_m)) * 1e3:.2f} mm off their middle"
            raise InputError("display.pitch_m", loaded.display.pitch_m, expected)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("--pixels-sweep", str(folder), f"a folder ({error.strerror})") from None
    for aim in sweep_aims:
        text = dumps(sequence_to_json(FrameSequence((), build_sweep(loaded, aim)))) + "\n"
        with atomic_write(folder / f"{aim.name}.json") as temporary:
            temporary.write_text(text, encoding="utf-8")
        pixel_map = PixelMap.uniform(count, aim.x_m, aim.y_m)
        write_pixel_map(folder / f"{aim.name}.pixels.toml", pixel_map, loaded, {"source": f"sweep, aim {aim.name}"})
    lines = _format_instructions(sweep_aims, loaded.name)
    with atomic_write(folder / README) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if json:
        print_json(
            {
                "folder": str(folder),
                "aims": [
                    aim._asdict() | dict(zip(PULSE_FIELDS, compute_pulse(loaded, aim), strict=True))
                    for aim in sweep_aims
                ],
                "pulses": count,
            }
        )
        return
    print(f"aims             {len(sweep_aims)}, a file each, {count} pulses")
    for aim, label in ((sweep_aims[0], "middle"), (sweep_aims[1], "across edges")):
        width_s, power_w = compute_pulse(loaded, aim)
        print(f"{label:<17}{width_s * 1e3:g} ms at {power_w:.3f} W")
    print(f"written          {folder}; {README} says what to play and to record")


def _format_instructions(sweep_aims: "list[Any]", name: str) -> list[str]:
    return [
        f"Play each file on {name} with the map beside it, the display cold before each:",
        "",
        *(f"    {aim.name}.json with --pixels-map {aim.name}.pixels.toml" for aim in sweep_aims),
        "",
        "Record, a run a pixel: the pulses, displacement_m with the pixel, from 20 ms before the pixel's pulse to",
        "100 ms after its end, a sample a millisecond or more; and where the beam was aimed, as attributes of the run:",
        "",
        *(f"    {aim.name}: aim_x_m = {aim.x_m!r}, aim_y_m = {aim.y_m!r}" for aim in sweep_aims),
        "",
        "All but the first leave part of the light beside the absorber: keep their power as low as it is.",
    ]
