"""`optodrive wire dump | replay`: list or replay a link capture."""

import json as json_module
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import JsonOption
from optodrive.cli.output import print_json

if TYPE_CHECKING:
    from optodrive.link.protocol.transcript import TranscriptEntry
    from optodrive.link.session.replay import Replay
    from optodrive.link.transport.link_capture import LinkCapture

LISTED_MAX = 8
"""Elements of a column shown in text; --json lists all."""
INVALID_SHOWN_BYTES = 32
CaptureArgument = Annotated[Path, typer.Argument(metavar="FILE", help="Output of `optodrive serve --capture`.")]


GROUP = typer.Typer(help="List or replay a capture of the link to a board.", no_args_is_help=True)


@GROUP.command()
def dump(file: CaptureArgument, json: JsonOption = False) -> None:
    """List every message with its time, then totals. With --json, print one object per line."""
    from optodrive.link.protocol.transcript import Transcript
    from optodrive.link.transport.link_capture import CLOSED, OPENED, TO_BOARD, LinkCapture

    capture, transcript = LinkCapture(file), Transcript()
    print_document = _print_json_line if json else _print_line
    for entry in capture.read_entries():
        at_s = entry.host_s - capture.host_s
        if entry.kind in (OPENED, CLOSED):
            transcript.reset_link()
            print_document({"t_s": at_s, "link": entry.kind})
            continue
        for line in transcript.feed(entry.host_s, entry.kind == TO_BOARD, entry.data):
            print_document(_build_document(line, capture))
    totals = {**transcript.totals.to_dict(), "ignored_bytes": capture.ignored_bytes}
    print_document({"totals": {"start_unix_s": capture.unix_s, **totals}})


def _build_document(line: "TranscriptEntry", capture: "LinkCapture") -> dict[str, Any]:
    from optodrive.link.protocol.transcript import describe

    document: dict[str, Any] = {"t_s": line.host_s - capture.host_s, "to": "board" if line.to_board else "host"}
    if line.message is None or line.frame is None:
        return {**document, "error": line.error, "bytes": len(line.raw), "hex": line.raw.hex()}
    document |= {"message": line.message.NAME, "session": line.frame.session}
    if line.message.SEQUENCED and line.to_board:
        document |= {"seq": line.frame.seq, "retransmitted": line.retransmitted}
    return {**document, "fields": describe(line.message)}


def _print_json_line(document: dict[str, Any]) -> None:
    sys.stdout.write(json_module.dumps(document, ensure_ascii=False) + "\n")


def _print_line(document: dict[str, Any]) -> None:
    if "totals" in document:
        print()
        for name, value in document["totals"].items():
            print(f"{name.replace('_', ' '):26} {'none' if value is None else _shorten(value)}")
        return
    at = f"{document['t_s']:12.6f}"
    if "link" in document:
        print(f"{at} -- link {document['link']}")
        return
    arrow = "->" if document["to"] == "board" else "<-"
    if "error" in document:
        shown = document["hex"][: 2 * INVALID_SHOWN_BYTES]
        more = "…" if len(shown) < len(document["hex"]) else ""
        print(f"{at} {arrow} INVALID {document['error']}, {document['bytes']} bytes: {shown}{more}")
        return
    seq = f" #{document['seq']}" if "seq" in document else ""
    retransmitted = " retransmitted" if document.get("retransmitted") else ""
    fields = " ".join(f"{name}={_shorten(value)}" for name, value in document["fields"].items())
    print(f"{at} {arrow} {document['message']}{seq}{retransmitted} {fields}".rstrip())


def _shorten(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + " ".join(f"{name}={_shorten(inner)}" for name, inner in value.items()) + "}"
    if isinstance(value, list):
        more = ",…" if len(value) > LISTED_MAX else ""
        return "[" + ",".join(_shorten(inner) for inner in value[:LISTED_MAX]) + more + "]"
    return f"{value:g}" if isinstance(value, float) and abs(value) < 1e5 else str(value)


@GROUP.command()
def replay(
    file: CaptureArgument,
    board: Annotated[str, typer.Option("--board", metavar="PORT", help="A serial port, or `simulated`.")],
    seed: Annotated[
        int | None,
        typer.Option("--seed", help="Seed of the captured simulated board; with another seed it does not arm."),
    ] = None,
    limits: Annotated[
        Path | None, typer.Option("--limits", metavar="FILE", help="Limits of the simulated board, TOML.")
    ] = None,
    baud: Annotated[
        int, typer.Option("--baud", min=300, max=12_000_000, help="Baud rate of the serial port.")
    ] = 1_000_000,
    json: JsonOption = False,
) -> None:
    """Send the captured bytes of the host to a board at their times. The exit status is 1 where its behaviour differs.

    A real board is never armed.
    """
    from optodrive.core.errors import InputError
    from optodrive.link.session.replay import compare_traces

    if board != "simulated" and (seed is not None or limits is not None):
        raise InputError("--board", board, "simulated: --seed and --limits apply to the simulated board only")
    result = _run_replay(file, board, seed, limits, baud)
    verdict = compare_traces(result.recorded, result.replayed)
    if json:
        print_json(verdict)
    else:
        _print_verdict(verdict, result)
    if not verdict["identical"]:
        raise typer.Exit(1)


def _run_replay(file: Path, board: str, seed: int | None, limits: Path | None, baud: int) -> "Replay":
    from optodrive.core.clock import ManualClock, MonotonicClock
    from optodrive.link.session.replay import Replay, clock_shift_s
    from optodrive.link.simulator.board_core import BoardCore
    from optodrive.link.simulator.guards import BoardSettings, load_settings
    from optodrive.link.simulator.virtual_run import MemoryLink
    from optodrive.link.transport.link_capture import LinkCapture
    from optodrive.link.transport.serial_port import SerialPort

    capture = LinkCapture(file)
    if board == "simulated":
        shift_s = clock_shift_s(capture.read_entries())
        clock = ManualClock(max(0.0, capture.host_s + shift_s))
        settings = BoardSettings() if limits is None else load_settings(limits)
        result = Replay(MemoryLink(BoardCore(settings, seed=seed), clock), clock, shift_s, may_arm=True)
    else:
        real = MonotonicClock()
        result = Replay(SerialPort(board, baud), real, real.now_s() - capture.host_s, may_arm=False)
    result.run(capture.read_entries())
    return result


def _print_verdict(verdict: dict[str, Any], result: "Replay") -> None:
    states, executed = verdict["states"], verdict["executed"]
    print("identical" if verdict["identical"] else "different")
    print(f"states           {states['recorded']} recorded, {states['replayed']} replayed")
    if states["first_difference"] is not None:
        at = states["first_difference"]
        recorded, replayed = (_format_state(account.states, at) for account in (result.recorded, result.replayed))
        print(f"first difference state {at + 1}: recorded {recorded}, replayed {replayed}")
    counts = ", ".join(f"{executed[name]} {name}" for name in ("recorded", "replayed", "missing", "changed", "shifted"))
    print(f"points executed  {counts}, by max {executed['largest_shift_ticks']} ticks")


def _format_state(states: list[tuple[str, str, str]], at: int) -> str:
    if at >= len(states):
        return "no further state"
    state, fault, reason = states[at]
    return f"{state}{f' {fault}' if fault else ''} ({reason})"
