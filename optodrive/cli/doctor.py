"""`optodrive doctor`: check the computer, the port and the board before a display is driven."""

import re
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.options import ConfigOption, JsonOption, StageOption
from optodrive.cli.output import Finding, print_json
from optodrive.core.clock import Clock

if TYPE_CHECKING:
    from collections.abc import Callable

    from optodrive.cli.output import Finding
    from optodrive.core.clock import Clock
    from optodrive.device.config import Config


INTERVAL_S = 2.0
NUMBER = re.compile(r"\d+(?:\.\d+)?")


def watch(examine: Callable[[], list[Finding]], clock: Clock) -> Iterator[list[Finding]]:
    """Yield all findings, and then, every INTERVAL_S, those that changed, without end.

    Numbers that vary, such as a round trip, are no change.
    """
    before: set[tuple[str, str, str]] = set()
    while True:
        findings = examine()
        changed = [finding for finding in findings if _build_key(finding) not in before]
        if changed:
            yield changed
        before = {_build_key(finding) for finding in findings}
        clock.sleep(INTERVAL_S)


def _build_key(finding: Finding) -> tuple[str, str, str]:
    return finding.check, finding.status, NUMBER.sub("#", finding.observation)


BAUD = 1_000_000
MARKS = {"ok": "ok     ", "warning": "warning", "problem": "PROBLEM"}


def doctor(
    config: ConfigOption = None,
    stage: StageOption = None,
    board: Annotated[
        str | None,
        typer.Option("--board", metavar="PORT", help="Examine the board on a serial port, without a configuration."),
    ] = None,
    baud: Annotated[
        int,
        typer.Option(
            "--baud", min=9600, max=12_000_000, metavar="N", help="Rate of that port; a board's own USB ignores it."
        ),
    ] = BAUD,
    watch: Annotated[bool, typer.Option("--watch", help="Repeat the checks until Ctrl-C and show changes.")] = False,
    json: JsonOption = False,
) -> None:
    """Check computer, port and board without arming. The exit status is 1 where there is a problem."""
    examination = partial(examine, config, stage=stage) if board is None else partial(examine_port, board, baud)
    if watch:
        _report_changes(examination, json)
        return
    findings = examination()
    counts = {f"{status}s": sum(each.status == status for each in findings) for status in ("problem", "warning")}
    if json:
        print_json({"ok": not counts["problems"], **counts, "findings": [finding._asdict() for finding in findings]})
    else:
        _print_findings(findings)
        print(", ".join(f"{count} {name[:-1] if count == 1 else name}" for name, count in counts.items()))
    if counts["problems"]:
        raise typer.Exit(1)


def _print_findings(findings: "list[Finding]") -> None:
    for finding in findings:
        print(f"{MARKS[finding.status]}  {finding.check:14} {finding.observation}")
        if finding.remedy:
            print(f"{'':9}{'':14} {finding.remedy}")


def _report_changes(examination: "Callable[[], list[Finding]]", json: bool) -> None:
    """Print all findings and then, with the time of day, those that change. With `json`, print one line per change."""
    from json import dumps

    from optodrive.core.clock import MonotonicClock

    for number, changed in enumerate(watch(examination, MonotonicClock())):
        if json:
            print(dumps({"unix_s": time.time(), "findings": [finding._asdict() for finding in changed]}), flush=True)
            continue
        if number:
            print(time.strftime("%H:%M:%S"))
        _print_findings(changed)
        sys.stdout.flush()


def examine(config: str | None, root: Path = Path("/"), stage: str | None = None) -> list["Finding"]:
    """Return all findings in order. `root` replaces / in tests.

    stage: the only one to examine, of several

    Raise InputError for a stage that the configuration does not have.
    """
    from optodrive.cli import doctor_host as host
    from optodrive.cli.config import EXCHANGE_REMEDY
    from optodrive.cli.output import report_problem, report_warning
    from optodrive.core.clock import MonotonicClock
    from optodrive.core.errors import InputError
    from optodrive.device.config_file import load_config

    clock = MonotonicClock()
    findings = [host.check_python(), *host.check_packages()]
    try:
        loaded = load_config(config)
    except InputError as error:
        return [
            *findings,
            report_problem("configuration", str(error), "correct it; `optodrive config check` checks it again"),
        ]
    stages = loaded.list_stage_configs() if stage is None else (loaded.select_stage(stage),)
    findings += [host.check_clock(clock, loaded.lease_s), host.check_governor(root)]
    findings += [*host.check_disk(), host.check_kernels()]
    exchangeable = loaded.find_exchangeable_boards()
    if exchangeable is not None:
        findings.append(report_warning("stages", exchangeable, EXCHANGE_REMEDY))
    for one in stages:
        found = _examine_board(one, clock, root, len(loaded.stages) > 1)
        if len(loaded.stages) > 1:
            found = [item._replace(check=f"{one.stages[0].name} {item.check}") for item in found]
        findings += found
    return findings


def examine_port(port: str, baud: int = BAUD, root: Path = Path("/")) -> list["Finding"]:
    """Return the findings on a serial port and the board on it, without a configuration."""
    from optodrive.cli.doctor_bare_board import check_bare_board
    from optodrive.cli.doctor_port import check_port
    from optodrive.core.clock import MonotonicClock
    from optodrive.core.errors import InputError
    from optodrive.device.config_sections import BoardSection
    from optodrive.link.transport.serial_port import SerialPort

    if not port.startswith("/"):
        raise InputError("--board", port, "the path of a serial port, such as /dev/ttyACM0")
    findings, free = check_port(BoardSection(transport="serial", port=port), root)
    return [*findings, *(check_bare_board(SerialPort(port, baud, "--board"), MonotonicClock()) if free else [])]


def _examine_board(config: "Config", clock: "Clock", root: Path, is_part: bool) -> list["Finding"]:
    """Return the findings on mirrors, port and board of one stage. is_part: whether there are others."""
    from optodrive.cli.doctor_board import check_board
    from optodrive.cli.doctor_host import check_mirrors
    from optodrive.cli.doctor_port import check_port

    mirrors = check_mirrors(config)
    if config.board.is_dac:
        from optodrive.cli.doctor_dac import check_dac

        return [mirrors, *check_dac(config, clock)]
    port, free = check_port(config.board, root)
    return [mirrors, *port, *(check_board(config, clock, is_part) if free else [])]
