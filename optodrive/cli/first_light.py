"""`optodrive first-light`: emit single weak pulses at the centre of the display, for the first time with the laser."""

from typing import Annotated

import typer

from optodrive.cli.board_access import confirm_emission
from optodrive.cli.commissioning_steps import report_steps
from optodrive.cli.options import ConfigOption, JsonOption, StageOption
from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity


def first_light(
    power_mw: Annotated[
        float | None,
        typer.Option("--power-mw", metavar="POWER_MW", help="Incident power of a pulse; default: 1 % of the laser's."),
    ] = None,
    pulses: Annotated[int, typer.Option("--pulses", help="Number of pulses of 20 ms, one per second.")] = 1,
    acknowledge: Annotated[
        bool,
        typer.Option("--acknowledge", help="Acknowledge a fault that the board still shows; its cause must be gone."),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Arm and emit without asking.")] = False,
    config: ConfigOption = None,
    stage: StageOption = None,
    json: JsonOption = False,
) -> None:
    """Check the board, centre the mirrors and emit single weak pulses there. The board ends disarmed in every case."""
    from optodrive.cli.board_access import open_board
    from optodrive.device.config_file import load_config
    from optodrive.lab.commissioning.exclusive_board import check_spot_power, spot_width_s
    from optodrive.lab.commissioning.homing import PULSES_MAX, default_power_w, emit_first_light

    loaded = load_config(config).select_stage(stage)
    power_w = default_power_w(loaded) if power_mw is None else power_mw * 1e-3
    check_spot_power(loaded, power_w, "--power-mw")
    if not 1 <= pulses <= PULSES_MAX:
        raise InputError("--pulses", pulses, f"1 to {PULSES_MAX}")
    duty = power_w / loaded.laser.max_power_w
    light = f"{format_quantity(power_w, 'W')} ({duty:.2%} duty) for {format_quantity(spot_width_s(loaded), 's')}"
    confirm_emission(
        yes,
        f"this arms the board and emits {pulses} pulse{'s' if pulses > 1 else ''} of {light} at the centre of the "
        "display. The enclosure is closed, the beam ends on the display or in a beam dump, and goggles are on",
    )
    with (
        report_steps("first_light", json, {"power_w": power_w}) as report_step,
        open_board(config, stage=stage) as (board, _),
    ):
        emit_first_light(board, power_w, pulses, acknowledge, report_step)
