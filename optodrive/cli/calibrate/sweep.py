"""`optodrive calibrate sweep`: play the whole sweep of a pixel calibration under one arming."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.board_access import confirm_emission
from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import print_answer, show_progress
from optodrive.core.errors import InputError

if TYPE_CHECKING:
    from optodrive.lab.calibration.pixel_sweep import Aim
    from optodrive.lab.commissioning.sweep_player import AimPlan
    from optodrive.planning.display_model import DisplayModel

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
    from optodrive.cli.calibrate.pixel_sweep import write_sweep_files
    from optodrive.cli.options import load_run_config
    from optodrive.planning.display_model import DisplayModel

    counts = write_sweep_files(out, config)[2]
    displays = [
        (aim, DisplayModel.from_config(load_run_config(config, None, pixel_map=out / f"{aim.name}.pixels.toml")))
        for aim in aims
    ]
    return displays, sum(counts)
