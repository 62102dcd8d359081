"""Commands that work on the board step by step: `optodrive home` and `optodrive first-light`.

`home` centres the mirrors and checks the board's inputs and outputs before any light is emitted; `first-light` emits
single weak pulses at the centre of the display, for the first time with the laser. Their output is a line per step, or
one JSON document at the end.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.board_access import confirm_emission
from optodrive.cli.options import ConfigOption, JsonOption, StageOption
from optodrive.cli.output import print_json
from optodrive.core.errors import InputError, OptodriveError
from optodrive.core.quantity import format_quantity

if TYPE_CHECKING:
    from optodrive.lab.commissioning.homing import HomingResult


@contextmanager
def report_steps(
    name: str, json: bool, fields: Mapping[str, object] | None = None
) -> Iterator[Callable[["HomingResult"], None]]:
    """Yield a function that reports a step. The document states under `name` whether all went well, and `fields`."""
    results: list[HomingResult] = []

    def report_step(step: "HomingResult") -> None:
        results.append(step)
        if not json:
            print(f"{step.step:<11} {step.message}", flush=True)

    failure = "interrupted"
    try:
        yield report_step
        failure = ""
    except OptodriveError as error:
        failure = str(error)
        raise
    finally:
        if json:
            steps = [{"step": step.step, "ok": True, "message": step.message, **step.details} for step in results]
            print_json({name: not failure, **(fields or {}), "steps": steps, "failure": failure or None})


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

    with report_steps("home", json) as report_step, open_board(config, stage=stage) as (board, sensor_reader):
        if spot_power_mw:
            check_spot_power(board.config, spot_power_mw * 1e-3)
        Homing(board, sensor_reader, spot_power_mw * 1e-3, acknowledge).run(report_step)


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
