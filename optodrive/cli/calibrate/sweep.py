"""`optodrive calibrate sweep`: play the whole sweep of a pixel calibration under one arming.

`optodrive calibrate pixels` fits the sweep; its files are the pulses per aim, their pixel maps and instructions.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.board_access import confirm_emission
from optodrive.cli.options import ConfigOption, JsonOption, load_run_config
from optodrive.cli.output import print_answer, show_progress
from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity

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
    from optodrive.cli.board_access import open_board
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
