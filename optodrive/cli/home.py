"""`optodrive home`: the mirrors to their middle, and everything a beam needs looked at before there is one."""

from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.options import ConfigOption, JsonOption, print_json
from optodrive.core.errors import OptodriveError

if TYPE_CHECKING:
    from optodrive.lab.commissioning.homing import Done


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("home")(home)


def home(
    config: ConfigOption = None,
    spot: Annotated[
        float, typer.Option("--spot", metavar="POWER_MW", min=0.0, help="Look with a spot of this power; else dark.")
    ] = 0.0,
    acknowledge: Annotated[
        bool,
        typer.Option("--acknowledge", help="Acknowledge a fault that the board still shows; its cause must be gone."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Bring the mirrors to their middle, look at travel, position outputs, interlock, key, stop, indicator."""
    from optodrive.cli.board_access import bench
    from optodrive.lab.commissioning.exclusive_board import check_power
    from optodrive.lab.commissioning.homing import Homing

    done: list[Done] = []

    def tell(step: "Done") -> None:
        done.append(step)
        if not json:
            print(f"{step.step:<11} {step.words}", flush=True)

    failure = "interrupted"
    try:
        with bench(config) as (held, eyes):
            if spot:
                check_power(held.config, spot * 1e-3)
            Homing(held, eyes, spot * 1e-3, acknowledge).run(tell)
        failure = ""
    except OptodriveError as error:
        failure = str(error)
        raise
    finally:
        if json:
            steps = [{"step": step.step, "ok": True, "says": step.words, **step.figures} for step in done]
            print_json({"home": not failure, "steps": steps, "failure": failure or None})
