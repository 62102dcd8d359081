"""`optodrive helios info | play`: a Helios laser DAC in place of the board."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import time as time_of_day
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import (
    ConfigOption,
    FitOption,
    JsonOption,
    ModelOption,
    PolicyOption,
    StrictOption,
    announce_compilation,
    configured,
    print_json,
    progress,
    report_lines,
)
from optodrive.core.errors import OptodriveError

if TYPE_CHECKING:
    from optodrive.core.clock import Clock
    from optodrive.core.types.plans import BudgetState
    from optodrive.link.helios.dac import Helios
    from optodrive.link.helios.heat_memory import Memory
    from optodrive.link.helios.player import Played
    from optodrive.link.helios.verification import ProvenFrames
    from optodrive.planning.pipeline import Display, Prepared

ENDED_BY = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _EndedError(OptodriveError):
    """A signal came."""

    code = "ended"
    exit_status = 130


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(help="Play on a Helios laser DAC; see docs/helios.md first.", no_args_is_help=True)
    group.command("info")(info)
    group.command("play")(play)
    app.add_typer(group, name="helios")


def info(config: ConfigOption = None, json: JsonOption = False) -> None:
    """Say which Helios is plugged in, and whether it may emit; it is stopped, and its shutter closed."""
    from optodrive.core.clock import MonotonicClock
    from optodrive.link.helios.dac import Helios

    board = configured(config, None).board
    with Helios(board, MonotonicClock()) as helios:
        figures = {
            "name": helios.name,
            "firmware": helios.version,
            "ready": helios.ready(),
            "may_emit": board.transport == "helios" and board.interlock_watched,
        }
    if json:
        print_json(figures)
        return
    print(f"name             {figures['name']}")
    print(f"firmware         {figures['firmware']}")
    print(f"ready            {'yes' if figures['ready'] else 'no'}")
    print(f"may emit         {'yes' if figures['may_emit'] else 'no: the configuration names no watched interlock'}")


def play(
    frames: Annotated[Path, typer.Argument(metavar="FRAMES.json", help="Frames and trains.")],
    config: ConfigOption = None,
    model: ModelOption = None,
    strict: StrictOption = False,
    policy: PolicyOption = "trim",
    fit: FitOption = "as_is",
    json: JsonOption = False,
) -> None:
    """Plan, limit and prove frames, play them on a Helios, and say what left; Ctrl-C ends the light."""
    from optodrive.core.clock import MonotonicClock
    from optodrive.link.helios.dac import Helios
    from optodrive.link.helios.encoding import PointScale
    from optodrive.link.helios.heat_memory import Memory
    from optodrive.link.helios.verification import prove
    from optodrive.planning.feasibility import admit
    from optodrive.planning.pipeline import Display, chosen
    from optodrive.planning.plan_summary import summary
    from optodrive.planning.stimuli.sequence_file import load_sequence

    display, clock = Display.of(configured(config, model)), MonotonicClock()
    helios = Helios(display.config.board, clock)
    helios.require_interlock()
    sequence = load_sequence(frames, display.config)
    announce_compilation()
    with _signals_noted() as heed, helios:
        memory = Memory.of(helios.name)
        heat, fresh = display.at_rest()
        budget = _cooled(memory, fresh, clock, heed)
        with progress("planning") as done:
            prepared, admission = admit(display, sequence, heat, budget, chosen(policy, strict), _both(heed, done), fit)
        proven = prove(prepared.plan, PointScale.of(display.config), budget, display.budget)
        with progress("playing") as done:
            played = _played(helios, memory, prepared, proven, clock, _both(heed, done))
    figures = {**summary(prepared, admission), "helios": _figures(display, prepared, proven, played)}
    if json:
        print_json(figures)
        return
    for line in [*report_lines(figures), *_lines(figures["helios"])]:
        print(line)


@contextmanager
def _signals_noted() -> Iterator[Callable[[], None]]:
    """Signals that end a process only leave a note here, so that none comes in the way of a stop; heed raises it."""
    noted: list[int] = []

    def heed() -> None:
        if noted:
            raise _EndedError(f"ended by {signal.Signals(noted[0]).name}")

    before = {number: signal.signal(number, lambda which, _frame: noted.append(which)) for number in ENDED_BY}
    try:
        yield heed
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _both(heed: Callable[[], None], done: Callable[[float], None]) -> Callable[[float], None]:
    def tick(share: float) -> None:
        heed()
        done(share)

    return tick


def _cooled(memory: "Memory", fresh: "BudgetState", clock: "Clock", heed: Callable[[], None]) -> "BudgetState":
    """The budget now, once all pulses of an earlier play have had their time."""
    budget = memory.recall(time_of_day(), fresh)
    while budget.at_s > 0.0:
        heed()
        clock.sleep(min(budget.at_s, 0.1))
        budget = memory.recall(time_of_day(), fresh)
    return budget


def _played(
    helios: "Helios",
    memory: "Memory",
    prepared: "Prepared",
    proven: "ProvenFrames",
    clock: "Clock",
    tick: Callable[[float], None],
) -> "Played":
    """Play, the memory written before the first light, and again after the last: a killed play counts in full."""
    from optodrive.link.helios.heat_memory import AHEAD_S
    from optodrive.link.helios.player import play

    memory.keep(prepared.budget, time_of_day() + AHEAD_S)
    try:
        return play(helios, proven, clock, tick)
    finally:
        memory.keep(prepared.budget, time_of_day() - min(proven.duration_s, prepared.budget.at_s))


def _figures(display: "Display", prepared: "Prepared", proven: "ProvenFrames", played: "Played") -> dict[str, Any]:
    from optodrive.core.units import m_to_um
    from optodrive.link.helios.encoding import PointScale

    pulses, plan = proven.pulses, prepared.plan
    shown = display.heat_at_rest().pulses(plan.pixel[proven.row], pulses.start_s, pulses.width_s, pulses.power_w)
    return {
        "points_per_s": 1.0 / PointScale.of(display.config).point_s,
        "frames": played.frames,
        "energy_j": proven.energy_j,
        "energy_planned_j": float(plan.energy_j.sum()),
        "predicted_max_um": m_to_um(float(shown.displacement_m.max())) if len(pulses) else 0.0,
        "holes": played.holes,
        "hole_s": played.hole_s,
    }


def _lines(figures: dict[str, Any]) -> list[str]:
    lines = [
        f"sent             {figures['frames']} frames at {figures['points_per_s']:.1f} points/s",
        f"light            {figures['energy_j']:.4f} J of {figures['energy_planned_j']:.4f} J planned",
        f"tallest so       {figures['predicted_max_um']:.1f} µm predicted of the light sent",
    ]
    if figures["holes"]:
        lines.append(f"holes            {figures['holes']}, dark for {figures['hole_s'] * 1e3:.1f} ms at least in all")
    return lines
