"""Play patterns on a daemon with a simulated board, and print targets, pulses sent and executed, and displacements."""

import argparse
import itertools
import subprocess
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from optodrive.cli.signals import end_as_interrupted
from optodrive.client.http import DaemonClient
from optodrive.client.plan import Plan
from optodrive.client.requests import ARM, READ_STATE, STOP, build_play_request, build_read_request
from optodrive.core.errors import InputError, LinkError, OptodriveError, RefusedError
from optodrive.daemon.api.tokens import build_tokens_path

PATTERNS = ("showcase", "experiment-1", "experiment-2", "experiment-3", "experiment-4", "experiment-5", "experiment-6")
COLUMNS = ("pattern", "planned", "sent", "executed", "target µm", "reached µm")


def start_daemon(port: int, config: str | None) -> tuple[subprocess.Popen[bytes], DaemonClient]:
    """Start a daemon and wait until it answers."""
    build_tokens_path(port).unlink(missing_ok=True)
    optodrive = Path(sys.executable).with_name("optodrive")
    chosen = ["--config", config] if config else []
    daemon = subprocess.Popen([optodrive, "serve", "--port", str(port), *chosen])
    try:
        while daemon.poll() is None:
            if build_tokens_path(port).exists():
                client = DaemonClient(f"http://127.0.0.1:{port}")
                try:
                    client.call(READ_STATE)
                except LinkError:
                    pass
                else:
                    return daemon, client
            time.sleep(0.05)
    except BaseException:
        daemon.terminate()
        daemon.wait()
        raise
    raise RefusedError("the daemon did not start; its message above gives the reason")


def choose_patterns(client: DaemonClient) -> list[str]:
    """Return the patterns that the display has the space for, and print why it has none for the others."""
    chosen = []
    for pattern in PATTERNS:
        try:
            client.call(build_play_request(pattern, {}, {"policy": "trim"}, dry_run=True))
        except InputError as error:
            print(f"left out: {error}", flush=True)
        else:
            chosen.append(pattern)
    if not chosen:
        raise RefusedError("no pattern of the demo fits this display")
    return chosen


def play_pattern(client: DaemonClient, pattern: str) -> Plan:
    """Play a pattern to its end. Return its plan."""
    plan = client.call(build_play_request(pattern, {}, {"policy": "trim"}, dry_run=False))
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed} of {task.total} pulses"),
        TimeElapsedColumn(),
    ) as bar:
        task = bar.add_task(f"{pattern:12}", total=plan.planned)
        while not plan.has_ended:
            time.sleep(0.05)
            plan = client.call(build_read_request(plan.plan, pulses=False))
            bar.update(task, completed=plan.executed)
    return plan


def format_row(name: str, plan: Plan) -> list[str]:
    """Format the result of one pattern as cells under COLUMNS."""
    target = plan.max_target
    heights = (
        [f"{target.target_um:.1f}", f"{target.simulated_um:.1f}"]
        if target
        else ["by pulse", f"{plan.simulated_max_um:.1f}"]
    )
    return [name, str(plan.planned), str(plan.sent), str(plan.executed), *heights]


def print_report(shown: list[tuple[str, Plan]]) -> bool:
    """Print the shown plans. Return whether every planned pulse was sent and executed."""
    done = [(name, plan) for name, plan in shown if plan.status == "done"]
    table = Table(*COLUMNS)
    for name, plan in done:
        table.add_row(*format_row(name, plan))
    Console().print(table)
    planned, sent, executed = (sum(getattr(plan, key) for _, plan in shown) for key in ("planned", "sent", "executed"))
    print(f"pulses planned {planned}, sent {sent}, executed {executed}")
    if done:
        name, highest = max(done, key=lambda item: item[1].simulated_max_um or 0.0)
        print(
            f"largest membrane displacement {highest.simulated_max_um or 0.0:.1f} µm, in {name}, "
            "also where pulses state a power instead of a height; computed from the executed pulses"
        )
    return planned == sent == executed > 0 and len(done) == len(shown)


def main() -> int:
    parser = argparse.ArgumentParser(prog="scripts/demo", description=__doc__)
    parser.add_argument("--seconds", type=float, help="duration of the demo; default: until Ctrl-C")
    parser.add_argument("--port", type=int, default=8450, help="TCP port of the daemon")
    parser.add_argument("--config", help="file or name of the display's configuration; default: display-437")
    options = parser.parse_args()
    shown: list[tuple[str, Plan]] = []
    daemon = None
    try:
        with end_as_interrupted():
            daemon, client = start_daemon(options.port, options.config)
            print("arming: the board's indicator is on for two seconds first", flush=True)
            client.call(ARM)
            started_s = time.monotonic()
            patterns = choose_patterns(client)
            for pattern in itertools.cycle(patterns):
                if options.seconds is not None and shown and time.monotonic() - started_s >= options.seconds:
                    break
                shown.append((pattern, play_pattern(client, pattern)))
            client.call(STOP)
    except KeyboardInterrupt:
        print("\nending")
    except OptodriveError as error:
        print(f"scripts/demo: {error}", file=sys.stderr)
        return error.exit_status
    finally:
        if daemon is not None:
            daemon.terminate()
            daemon.wait()
    return 0 if shown and print_report(shown) else 1


if __name__ == "__main__":
    sys.exit(main())
