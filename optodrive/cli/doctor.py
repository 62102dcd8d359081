"""`optodrive doctor`: check the computer, the port and the board before a display is driven."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import print_json

if TYPE_CHECKING:
    from optodrive.cli.doctor_finding import Finding

MARKS = {"ok": "ok     ", "warning": "warning", "problem": "PROBLEM"}


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(doctor)


def doctor(
    config: ConfigOption = None,
    watch: Annotated[bool, typer.Option("--watch", help="Repeat the checks until Ctrl-C and show changes.")] = False,
    json: JsonOption = False,
) -> None:
    """Check computer, port and board without arming; exit status 1 where there is a problem."""
    if watch:
        _report_changes(config, json)
        return
    findings = examine(config)
    problems = sum(finding.status == "problem" for finding in findings)
    warnings = sum(finding.status == "warning" for finding in findings)
    if json:
        counts = {"problems": problems, "warnings": warnings}
        print_json({"ok": not problems, **counts, "findings": [finding._asdict() for finding in findings]})
    else:
        _print_findings(findings)
        print(f"{problems} problems, {warnings} warnings")
    if problems:
        raise typer.Exit(1)


def _print_findings(findings: "list[Finding]") -> None:
    for finding in findings:
        print(f"{MARKS[finding.status]}  {finding.check:14} {finding.observation}")
        if finding.remedy:
            print(f"{'':9}{'':14} {finding.remedy}")


def _report_changes(config: str | None, json: bool) -> None:
    """Print all findings and then, with the time of day, those that change; with `json`, one line per change."""
    from json import dumps

    from optodrive.cli.doctor_watch import watch
    from optodrive.core.clock import MonotonicClock

    for number, changed in enumerate(watch(lambda: examine(config), MonotonicClock())):
        if json:
            print(dumps({"unix_s": time.time(), "findings": [finding._asdict() for finding in changed]}), flush=True)
            continue
        if number:
            print(time.strftime("%H:%M:%S"))
        _print_findings(changed)
        sys.stdout.flush()


def examine(config: str | None, root: Path = Path("/")) -> list["Finding"]:
    """Return all findings in order; `root` replaces / in tests."""
    from optodrive.cli import doctor_host as host
    from optodrive.cli.doctor_board import check_board
    from optodrive.cli.doctor_finding import report_problem
    from optodrive.cli.doctor_port import check_port
    from optodrive.core.clock import MonotonicClock
    from optodrive.core.errors import InputError
    from optodrive.device.config_file import load_config

    clock = MonotonicClock()
    findings = [host.check_python(), *host.check_packages()]
    try:
        loaded = load_config(config)
        loaded.require_one_stage()
    except InputError as error:
        return [
            *findings,
            report_problem("configuration", str(error), "correct it; `optodrive config check` checks it again"),
        ]
    findings += [host.check_clock(clock, loaded.board.lease_s), host.check_governor(root)]
    findings += [*host.check_disk(), host.check_kernels()]
    if loaded.board.transport == "helios":
        from optodrive.cli.doctor_helios import check_helios

        return [*findings, *check_helios(loaded, clock)]
    port, free = check_port(loaded.board, root)
    return [*findings, *port, *(check_board(loaded, clock) if free else [])]
