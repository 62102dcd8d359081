"""`optodrive push | play | patterns`: frames and named patterns to a running daemon."""

import base64
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import (
    DEFAULT_URL,
    FitOption,
    JsonOption,
    PolicyOption,
    StrictOption,
    UrlOption,
    format_plan_summary,
    print_json,
    show_progress,
)
from optodrive.core.errors import InputError, RefusedError

if TYPE_CHECKING:
    from optodrive.client.http import DaemonClient

POLL_S = 0.1

DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Plan and limit only; nothing moves.")]
WaitOption = Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until it was shown.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (push, play, patterns):
        app.command()(command)


def push(
    frames: Annotated[Path, typer.Argument(metavar="FRAMES.json", help="Frames and trains.")],
    url: UrlOption = DEFAULT_URL,
    dry_run: DryRunOption = False,
    strict: StrictOption = False,
    policy: PolicyOption = "trim",
    fit: FitOption = "as_is",
    wait: WaitOption = True,
    json: JsonOption = False,
) -> None:
    """Plan frames and trains, show them, and say what was executed."""
    from optodrive.client.http import DaemonClient

    try:
        body = frames.read_bytes()
    except OSError as error:
        raise InputError(str(frames), error.strerror, "a readable file") from None
    remote = DaemonClient(url)
    query = {"dry_run": dry_run, "strict": strict, "policy": policy, "fit": fit}
    answer = remote.call("POST", "/v1/plans", content=body, params=query, headers={"Content-Type": "application/json"})
    _follow_plan(remote, answer, wait, json)


def play(
    pattern: Annotated[str, typer.Argument(metavar="PATTERN", help="A name that `optodrive patterns` lists.")],
    values: Annotated[list[str] | None, typer.Argument(metavar="[KEY=VALUE]…", help="Its parameters.")] = None,
    url: UrlOption = DEFAULT_URL,
    dry_run: DryRunOption = False,
    strict: StrictOption = False,
    policy: PolicyOption = "trim",
    fit: FitOption = "as_is",
    wait: WaitOption = True,
    json: JsonOption = False,
) -> None:
    """Play a named pattern, for example: play text "hello" height_um=150."""
    from optodrive.client.http import DaemonClient

    parameters = _parse_parameters(pattern, values or [])
    remote = DaemonClient(url)
    query = {"dry_run": dry_run, "strict": strict, "policy": policy, "fit": fit}
    answer = remote.call("POST", f"/v1/patterns/{pattern}", json=parameters, params=query)
    _follow_plan(remote, answer, wait, json)


def patterns(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """List the patterns and their parameters; needs no daemon."""
    from optodrive.planning.stimuli.pattern_registry import describe_patterns

    descriptions = describe_patterns()
    if json:
        print_json({"patterns": descriptions})
        return
    for item in descriptions:
        print(f"{item['name']}: {item['summary']}")
        for parameter in item["parameters"]:
            choices = f" ({', '.join(str(choice) for choice in parameter['choices'])})" if parameter["choices"] else ""
            print(f"    {parameter['name']}={parameter['default']}{choices}  {parameter['description']}")


def _parse_parameters(pattern: str, values: list[str]) -> dict[str, str]:
    from optodrive.planning.stimuli.pattern_registry import find_pattern

    known = find_pattern(pattern).parameters
    parsed: dict[str, str] = {}
    for value in values:
        key, equals, content = value.partition("=")
        if not equals or key not in {p.name for p in known}:
            if known and known[0].name not in parsed and not equals:
                key, content = known[0].name, value  # a bare word is the first parameter: play text "hello"
            elif not equals:
                raise InputError(f"play {pattern}", value, "key=value")
        parsed[key] = content
    for parameter in known:
        if parameter.kind == "file" and parameter.name in parsed:
            parsed[parameter.name] = _encode_file(Path(parsed[parameter.name]))
    return parsed


def _encode_file(path: Path) -> str:
    try:
        return base64.b64encode(path.read_bytes()).decode("ascii")
    except OSError as error:
        raise InputError(str(path), error.strerror, "a readable file") from None


def _follow_plan(remote: "DaemonClient", answer: dict[str, Any], wait: bool, as_json: bool) -> None:
    if wait and answer["status"] in ("queued", "running"):
        answer = _wait_until_shown(remote, answer)
    if as_json:
        print_json(answer)
    else:
        for line in format_plan_summary(answer["summary"]):
            print(line)
        print(f"plan             {answer['plan']}: {answer['status']}")
        if answer["status"] == "done":
            print(f"executed         {answer['executed']} of {answer['sent']} sent, {answer['planned']} planned")
    if answer["status"] == "failed":
        raise RefusedError(f"plan {answer['plan']} failed: {answer['error']}")


def _wait_until_shown(remote: "DaemonClient", answer: dict[str, Any]) -> dict[str, Any]:
    with show_progress("showing") as on_progress:
        while answer["status"] in ("queued", "running"):
            time.sleep(POLL_S)
            answer = remote.call("GET", f"/v1/plans/{answer['plan']}", params={"pulses": False})
            on_progress(answer["executed"] / max(1, answer["planned"]))
    return remote.call("GET", f"/v1/plans/{answer['plan']}")
