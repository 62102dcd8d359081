"""`optodrive home`: centre the mirrors and check the board's inputs and outputs before any light is emitted."""

from typing import Annotated

import typer

from optodrive.cli.commissioning_steps import report_steps
from optodrive.cli.options import ConfigOption, JsonOption, StageOption


def home(
    config: ConfigOption = None,
    stage: StageOption = None,
    spot_power_mw: Annotated[
        float, typer.Option("--spot-power-mw", metavar="POWER_MW", min=0.0, help="Power of the spot; 0: gate off.")
    ] = 0.0,
    acknowledge: Annotated[
        bool,
        typer.Option("--acknowledge", help="Acknowledge a fault that the board still shows; its cause must be gone."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Centre the mirrors. Check travel, position outputs, interlock, key, emergency stop and indicator."""
    from optodrive.cli.board_access import open_board
    from optodrive.lab.commissioning.exclusive_board import check_spot_power
    from optodrive.lab.commissioning.homing import Homing

    with report_steps("home", json) as report_step, open_board(config, stage=stage) as (board, spot_reader):
        if spot_power_mw:
            check_spot_power(board.config, spot_power_mw * 1e-3)
        Homing(board, spot_reader, spot_power_mw * 1e-3, acknowledge).run(report_step)
