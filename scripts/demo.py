"""Plays patterns on a daemon with a simulated board, and says what was asked for, sent, executed and felt."""

import argparse
import itertools
import subprocess
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from optodrive.client.http import DaemonClient
from optodrive.core.errors import LinkError, OptodriveError, RefusedError
from optodrive.daemon.web.tokens import build_tokens_path

PATTERNS = ("showcase", "experiment-1", "experiment-2", "experiment-3", "experiment-4", "experiment-5", "experiment-6")
START_TIMEOUT_S = 30.0
COLUMNS = ("pattern", "planned", "sent", "executed", "asked µm", "got µm")


def start_daemon(port: int) -> tuple[subprocess.Popen[bytes], DaemonClient]:
    build_tokens_path(port).unlink(missing_ok=True)
    optodrive = Path(sys.executable).with_name("optodrive")
    daemon = subprocess.Popen([optodrive, "serve", "--port", str(port)])
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline_s and daemon.poll() is None:
        if build_tokens_path(port).exists():
            remote = DaemonClient(f"http://127.0.0.1:{port}")
            try:
                remote.call("GET", "/v1/state")
            except LinkError:
                pass
            else:
                return daemon, remote
        time.sleep(0.05)
    daemon.terminate()
    raise RefusedError("the daemon did not start; its own line above says why")


def play_pattern(remote: DaemonClient, pattern: str) -> dict:
    """Play a pattern to its end; what came of it."""
    answer = remote.call("POST", f"/v1/patterns/{pattern}")
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed} of {task.total} pulses"),
        TimeElapsedColumn(),
    ) as bar:
        task = bar.add_task(f"{pattern:12}", total=answer["planned"])
        while answer["status"] in ("queued", "running"):
            time.sleep(0.05)
            answer = remote.call("GET", f"/v1/plans/{answer['plan']}", params={"pulses": False})
            bar.update(task, completed=answer["executed"])
    return answer


def format_row(name: str, answer: dict) -> list[str]:
    asked = answer["tallest_asked"]
    heights = (
        [f"{asked['asked_um']:.1f}", f"{asked['simulated_um']:.1f}"]
        if asked
        else ["by pulse", f"{answer['simulated_max_um']:.1f}"]
    )
    return [name, *(str(answer[key]) for key in ("planned", "sent", "executed")), *heights]


def print_report(shown: list[tuple[str, dict]]) -> bool:
    """Print what came of it; whether every pulse planned was sent and executed."""
    done = [(name, answer) for name, answer in shown if answer["status"] == "done"]
    table = Table(*COLUMNS)
    for name, answer in done:
        table.add_row(*format_row(name, answer))
    Console().print(table)
    planned, sent, executed = (sum(answer[key] for _, answer in shown) for key in ("planned", "sent", "executed"))
    print(f"pulses planned {planned}, sent {sent}, executed {executed}")
    with_target = [answer["tallest_asked"] for _, answer in done if answer["tallest_asked"]]
    if with_target:
        tallest = max(with_target, key=lambda item: item["asked_um"])
        print(
            f"tallest membrane displacement {tallest['simulated_um']:.1f} µm, computed from the executed pulses; "
            f"{tallest['asked_um']:.1f} µm asked for"
        )
    return planned == sent == executed > 0 and len(done) == len(shown)


def main() -> int:
    parser = argparse.ArgumentParser(prog="scripts/demo", description=__doc__)
    parser.add_argument("--seconds", type=float, help="show for about so long, then end; without it, until Ctrl-C")
    parser.add_argument("--port", type=int, default=8450, help="TCP port of the daemon")
    options = parser.parse_args()
    shown: list[tuple[str, dict]] = []
    daemon = None
    try:
        daemon, remote = start_daemon(options.port)
        print("arming: the board's indicator is lit for two seconds first", flush=True)
        remote.call("POST", "/v1/arm")
        started_s = time.monotonic()
        for pattern in itertools.cycle(PATTERNS):
            if options.seconds is not None and shown and time.monotonic() - started_s >= options.seconds:
                break
            shown.append((pattern, play_pattern(remote, pattern)))
        remote.call("POST", "/v1/stop")
    except KeyboardInterrupt:
        print("\nending")
    except OptodriveError as error:
        print(f"scripts/demo: {error}", file=sys.stderr)
        return error.exit_status
    finally:
        if daemon is not None:
            daemon.terminate()
            daemon.wait(timeout=10)
    return 0 if shown and print_report(shown) else 1


if __name__ == "__main__":
    sys.exit(main())
