"""`optodrive dac list | info | play`: play frames on a laser DAC instead of the board."""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

import typer

from optodrive.cli.invocation import exit_unless_fits
from optodrive.cli.options import (
    ConfigOption,
    JsonOption,
    ModelOption,
    load_run_config,
)
from optodrive.cli.output import announce_compilation, print_answer, show_progress
from optodrive.cli.plan import format_plan_summary
from optodrive.cli.push_options import add_push_options
from optodrive.core.errors import OptodriveError
from optodrive.core.quantity import format_quantity
from optodrive.core.types.push_options import PushOptions

if TYPE_CHECKING:
    from optodrive.link.dac.discovery import FoundDac
if TYPE_CHECKING:
    from optodrive.core.clock import Clock
    from optodrive.core.types.plans import BudgetState
    from optodrive.link.dac.laser_dac import LaserDac
    from optodrive.link.dac.player import PlaybackReport, VerifiedChunks
    from optodrive.planning.display_model import DisplayModel
    from optodrive.planning.heat_record import HeatRecord
    from optodrive.planning.planned_sequence import PlannedSequence


def summarize_dacs(found: "list[FoundDac]") -> tuple[dict[str, Any], list[str]]:
    """Return the document and the lines on found DACs."""
    lines = [f"{dac.transport:<12} {dac.port:<16} {dac.name}: {dac.description}" for dac in found]
    return {"dacs": [asdict(dac) for dac in found]}, lines or ["no laser DAC found"]


TERMINATING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _TerminatedError(OptodriveError):
    """A signal requested the end of the process."""

    code = "terminated"
    exit_status = 130


GROUP = typer.Typer(help="Play on a laser DAC; see docs/how-to/use-a-laser-dac.md first.", no_args_is_help=True)


@GROUP.command("list")
def list_dacs(json: JsonOption = False) -> None:
    """Show the laser DACs on USB and in the network within two seconds. None is played because it was found."""
    from optodrive.core.clock import MonotonicClock
    from optodrive.link.dac.discovery import find_dacs

    print_answer(*summarize_dacs(find_dacs(MonotonicClock())), json)


@GROUP.command()
def info(config: ConfigOption = None, json: JsonOption = False) -> None:
    """Show the configured DAC and whether it may emit. It is stopped, and its light switched off."""
    from optodrive.core.clock import MonotonicClock
    from optodrive.link.dac.registry import build_dac
    from optodrive.planning.display_model import DisplayModel
    from optodrive.planning.heat_record import read_heat

    display, clock = DisplayModel.from_config(load_run_config(config, None)), MonotonicClock()
    board = display.config.board
    with build_dac(board, clock) as dac:
        _, heat = read_heat(dac.transport, dac.find_uid(), display, clock)
        document = {
            "device": dac.format.label,
            "name": dac.name,
            "firmware": dac.firmware,
            "ready": dac.is_ready(),
            "may_emit": board.interlock_watched,
            "heat": heat,
        }
    lines = [
        f"device           {document['device']}",
        f"name             {document['name']}",
        f"firmware         {document['firmware']}",
        f"ready            {'yes' if document['ready'] else 'no'}",
        f"may emit         {'yes' if document['may_emit'] else 'no: the configuration names no watched interlock'}",
        f"heat             {document['heat']}",
    ]
    print_answer(document, lines, json)


@GROUP.command()
@add_push_options
def play(
    frames: Annotated[Path, typer.Argument(metavar="FRAMES.json", help="Frames and trains.")],
    config: ConfigOption = None,
    model: ModelOption = None,
    json: JsonOption = False,
    **options: Unpack[PushOptions],
) -> None:
    """Plan, limit and verify frames, play them on a DAC, report the sent pulses. Ctrl-C switches the light off."""
    from optodrive.core.clock import MonotonicClock
    from optodrive.link.dac.encoding import PointScale
    from optodrive.link.dac.player import encode_verified
    from optodrive.link.dac.registry import build_dac
    from optodrive.planning.display_model import DisplayModel
    from optodrive.planning.feasibility.check import check_feasibility
    from optodrive.planning.heat_record import HeatRecord
    from optodrive.planning.plan_summary import summarize_plan
    from optodrive.planning.stimuli.sequence_file import load_sequence

    display, clock = DisplayModel.from_config(load_run_config(config, model)), MonotonicClock()
    display.config.select_stage(None)
    dac = build_dac(display.config.board, clock)
    dac.require_interlock()
    sequence = load_sequence(frames, display.config)
    announce_compilation()
    with (
        _defer_signals() as raise_if_signalled,
        dac,
        HeatRecord(dac.transport, dac.find_uid(), display, clock, raise_if_signalled) as record,
    ):
        budget = _recall_budget(record, clock)
        with show_progress("planning") as on_progress:
            planned_sequence, feasibility = check_feasibility(
                display,
                sequence,
                display.build_cold_heat(),
                budget,
                _combine_progress(raise_if_signalled, on_progress),
                **options,
            )
        verified = encode_verified(
            planned_sequence.plan, PointScale.from_config(display.config), budget, display.budget
        )
        with show_progress("playing") as on_progress:
            on_progress = _combine_progress(raise_if_signalled, on_progress)
            playback = _play_and_record(dac, record, budget, display, planned_sequence, verified, clock, on_progress)
    summary = summarize_plan(planned_sequence, feasibility)
    playback_summary = _summarize_playback(dac, display, planned_sequence, verified, playback)
    document = {**summary.model_dump(mode="json"), "dac": playback_summary}
    print_answer(document, [*format_plan_summary(summary), *_format_playback(playback_summary)], json)
    exit_unless_fits(feasibility)


@contextmanager
def _defer_signals() -> Iterator[Callable[[], None]]:
    """Defer terminating signals, so that none interrupts a stop.

    Yield the function that raises for a received one.
    """
    received: list[int] = []

    def raise_if_signalled() -> None:
        if received:
            raise _TerminatedError(f"terminated by {signal.Signals(received[0]).name}")

    previous_handlers = {
        number: signal.signal(number, lambda signum, _frame: received.append(signum)) for number in TERMINATING_SIGNALS
    }
    try:
        yield raise_if_signalled
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def _combine_progress(
    raise_if_signalled: Callable[[], None], show_fraction: Callable[[float], None]
) -> Callable[[float], None]:
    def on_progress(fraction: float) -> None:
        raise_if_signalled()
        show_fraction(fraction)

    return on_progress


def _recall_budget(record: "HeatRecord", clock: "Clock") -> "BudgetState":
    """Return the present budget state, and say so if the display counts as hot."""
    budget = record.load()
    if record.hot_reason:
        print(f"optodrive: the display counts as {record.describe()}", file=sys.stderr)
    while budget.at_s > 0.0:
        clock.sleep(budget.at_s)
        budget = record.load()
    return budget


def _play_and_record(
    dac: "LaserDac",
    record: "HeatRecord",
    before: "BudgetState",
    display: "DisplayModel",
    planned_sequence: "PlannedSequence",
    verified: "VerifiedChunks",
    clock: "Clock",
    on_progress: Callable[[float], None],
) -> "PlaybackReport":
    """Play the chunks and record the heat after them.

    Of a playback that ends early, what may have been sent counts.
    """
    from optodrive.link.dac.player import play
    from optodrive.planning.limiter.limiter import commit_until

    ends_s = [0.0, *accumulate(chunk.duration_s for chunk in verified.chunks)]
    sent = 0

    def note_progress(fraction: float) -> None:
        nonlocal sent
        sent = round(fraction * len(verified.chunks))
        on_progress(fraction)

    record.begin_use()
    try:
        playback = play(dac, verified, clock, note_progress)
    except BaseException:
        sent_s = ends_s[min(sent + 1, len(verified.chunks))]  # one more may have left
        budget = commit_until(planned_sequence.plan, sent_s, before, display.budget)
        # What was sent may have waited in the device, and its pulses have come as much later.
        record.save(budget, max(0.0, ends_s[sent] - dac.format.host_loss_max_s))
        raise
    record.save(planned_sequence.budget, max(0.0, min(verified.duration_s, planned_sequence.budget.at_s)))
    return playback


def _summarize_playback(
    dac: "LaserDac",
    display: "DisplayModel",
    planned_sequence: "PlannedSequence",
    verified: "VerifiedChunks",
    playback: "PlaybackReport",
) -> dict[str, Any]:
    from optodrive.core.quantity import m_to_um
    from optodrive.link.dac.encoding import PointScale

    pulses, plan = verified.pulses, planned_sequence.plan
    response = display.build_cold_heat().apply_pulses(
        plan.pixel[verified.row], pulses.start_s, pulses.width_s, pulses.power_w
    )
    return {
        "points_per_s": 1.0 / PointScale.from_config(display.config).point_s,
        "device": dac.format.label,
        "chunks": playback.chunks,
        "energy_j": verified.energy_j,
        "energy_planned_j": float(plan.energy_j.sum()),
        "predicted_max_um": m_to_um(float(response.displacement_m.max())) if len(pulses) else 0.0,
        "underruns": playback.underruns,
        "underrun_s": playback.underrun_s,
    }


def _format_playback(playback: dict[str, Any]) -> list[str]:
    lines = [
        f"sent             {playback['chunks']} chunks at {playback['points_per_s']:.1f} points/s",
        f"light            {playback['energy_j']:.4f} J of {playback['energy_planned_j']:.4f} J planned",
        f"highest          {playback['predicted_max_um']:.1f} µm predicted of the light sent",
    ]
    if playback["underruns"]:
        lines.append(
            f"underruns        {playback['underruns']}, at least {format_quantity(playback['underrun_s'], 's')} in all"
        )
    return lines
