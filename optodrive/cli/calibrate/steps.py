"""`optodrive calibrate steps`: play the mirror steps that `calibrate servo` needs, with the gate off."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.options import ConfigOption, JsonOption, StageOption
from optodrive.cli.output import print_json
from optodrive.core.errors import InputError

if TYPE_CHECKING:
    from optodrive.core.types.arrays import FloatArray
    from optodrive.core.types.measurements import Signal
    from optodrive.device.config import Config
    from optodrive.lab.commissioning.mirror_steps import StepRun
    from optodrive.planning.display_model import DisplayModel

PAUSE_MAX_S = 60.0
LAST_STEP_S = 0.015
"""Time for which the last step is recorded."""
NOTES = "Steps of optodrive calibrate steps. Add mirror_x_rad.csv and mirror_y_rad.csv to each run."


def steps(
    out: Annotated[Path, typer.Option("--out", metavar="FOLDER", help="Write the commands: a recording to complete.")],
    step_count: Annotated[int, typer.Option("--steps", help="Steps of mirror x per size; y has half as many.")] = 24,
    pause_s: Annotated[
        float, typer.Option("--pause", metavar="SECONDS", help="Pause between sizes, in which a scope rearms.")
    ] = 2.0,
    config: ConfigOption = None,
    stage: StageOption = None,
    json: JsonOption = False,
) -> None:
    """Play steps of both mirrors in three sizes with the gate off, for a recording of their position outputs."""
    from optodrive.cli.board_access import open_board
    from optodrive.core.files import check_output
    from optodrive.lab.commissioning.mirror_steps import LEAD_IN_S, plan_step_runs, play_step_runs

    check_output("--out", out, folder=True)
    if not 0.0 <= pause_s <= PAUSE_MAX_S:
        raise InputError("--pause", pause_s, f"0 to {PAUSE_MAX_S:g} s")
    played: list[tuple[StepRun, FloatArray]] = []

    def report_run(run: "StepRun", commands: "FloatArray") -> None:
        played.append((run, commands))
        if not json:
            x_rad, y_rad = commands[1, 1:] - commands[0, 1:]
            size = f"{x_rad:.4f} rad in x and {y_rad:.4f} rad in y"
            print(f"{run.name:<17}{len(commands) - 1} steps of {size}, {commands[-1, 0]:.2f} s", flush=True)

    with open_board(config, stage=stage) as (board, _):
        runs = plan_step_runs(board, step_count)
        board.connect()
        board.arm()
        play_step_runs(runs, board, pause_s, report_run)
        board.disarm()
        display = board.display
    is_simulated = display.config.board.transport == "simulated"
    _write_commands(out, played, display, is_simulated)
    if json:
        print_json({"recording": str(out), "trigger_s": LEAD_IN_S, "runs": [run.name for run, _ in played]})
        return
    print(f"written          {out}; the first step of a run is at {LEAD_IN_S:g} s of its time")
    if is_simulated:
        print("simulated        with what a scope would measure on mirrors with the configured servo, to rehearse")
        print(f"next             optodrive calibrate servo {out}")


def _write_commands(
    out: Path, played: "list[tuple[StepRun, FloatArray]]", display: "DisplayModel", is_simulated: bool
) -> None:
    """Write the commands of each run, with the traces of a scope for a simulated board."""
    import numpy as np

    from optodrive.core.types.measurements import Measurement, Run
    from optodrive.lab.recording import write_recording

    runs = []
    for seed, (run, commands) in enumerate(played):
        signals = _measure(display.config, commands, seed) if is_simulated else {}
        runs.append(Run(run.name, display.ambient_k, np.zeros((0, 4)), signals, {}, commands))
    write_recording(out, Measurement(tuple(runs)), "" if is_simulated else NOTES)


def _measure(config: "Config", commands: "FloatArray", seed: int) -> "dict[str, Signal]":
    from optodrive.core.types.measurements import Signal
    from optodrive.link.simulator.galvos import measure_position_outputs

    t_s, x_rad, y_rad = measure_position_outputs(config, commands, float(commands[-1, 0]) + LAST_STEP_S, seed).T.copy()
    return {"mirror_x_rad": Signal(0, t_s, x_rad), "mirror_y_rad": Signal(0, t_s, y_rad)}
