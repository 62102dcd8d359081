"""`optodrive push | play | patterns`: frames and named patterns to a running daemon."""

import base64
import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from optodrive.cli.options import (
    DEFAULT_URL,
    FitOption,
    HoldOption,
    JsonOption,
    PatternPolicyOption,
    PolicyOption,
    StrictOption,
    UrlOption,
)
from optodrive.cli.output import print_json, show_progress
from optodrive.cli.plan_text import format_plan_summary
from optodrive.core.errors import InputError

if TYPE_CHECKING:
    from optodrive.client.http import DaemonClient
    from optodrive.client.plan import Plan
    from optodrive.planning.stimuli.pattern import PatternParameter

POLL_S = 0.1

DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Plan and limit only; do not show.")]
WaitOption = Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until the plan has been shown.")]


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
    hold: HoldOption = False,
    json: JsonOption = False,
) -> None:
    """Plan frames and trains, show them, and report what was executed."""
    from optodrive.client.http import DaemonClient
    from optodrive.client.requests import build_push_request

    try:
        body = frames.read_bytes()
    except OSError as error:
        raise InputError(str(frames), error.strerror, "a readable file") from None
    client = DaemonClient(url)
    with _hold_if(hold, client, dry_run, wait):
        _follow_plan(client, client.call(build_push_request(body, policy, fit, dry_run, strict)), wait, json)


def play(
    pattern: Annotated[str, typer.Argument(metavar="PATTERN", help="A name that `optodrive patterns` lists.")],
    values: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE", help="Pattern parameters.")] = None,
    url: UrlOption = DEFAULT_URL,
    dry_run: DryRunOption = False,
    strict: StrictOption = False,
    policy: PatternPolicyOption = None,
    fit: FitOption = "as_is",
    wait: WaitOption = True,
    hold: HoldOption = False,
    json: JsonOption = False,
) -> None:
    """Play a named pattern, for example: play text "hello" height_um=150."""
    from optodrive.client.http import DaemonClient
    from optodrive.client.requests import build_play_request

    parameters = _parse_parameters(pattern, values or [])
    client = DaemonClient(url)
    request = build_play_request(pattern, parameters, policy, fit, dry_run, strict)
    with _hold_if(hold, client, dry_run, wait):
        _follow_plan(client, client.call(request), wait, json)


def _hold_if(hold: bool, client: "DaemonClient", dry_run: bool, wait: bool) -> AbstractContextManager[object]:
    """Arm the board until the command ends, if `hold`."""
    if not hold:
        return nullcontext()
    if dry_run or not wait:
        other = "--dry-run" if dry_run else "--no-wait"
        raise InputError("--hold", other, "a command that shows a plan and waits for its end")
    from optodrive.client.hold import Hold

    return Hold(client.policy.endpoint)


def patterns(url: UrlOption = DEFAULT_URL, json: JsonOption = False) -> None:
    """List the patterns and their parameters; needs no daemon."""
    from optodrive.planning.stimuli.pattern_registry import describe_patterns

    descriptions = describe_patterns()
    if json:
        print_json({"patterns": descriptions})
        return
    for item in descriptions:
        print(f"{item.name}: {item.summary}")
        for parameter in item.parameters:
            default = "" if parameter.default is None else f"={parameter.default}"
            print(f"    {parameter.name}{default}{_format_bounds(parameter)}  {parameter.description}")


def _format_bounds(parameter: "PatternParameter") -> str:
    if parameter.choices:
        return f" ({', '.join(parameter.choices)})"
    unit = f" {parameter.unit}" if parameter.unit else ""
    if parameter.min is None or parameter.max is None:
        return f" ({parameter.kind})"
    return f" ({parameter.min:g} to {parameter.max:g}{unit})"


def _parse_parameters(pattern: str, values: list[str]) -> dict[str, str]:
    from optodrive.planning.stimuli.pattern_registry import find_pattern

    known = find_pattern(pattern).parameters
    parsed: dict[str, str] = {}
    for value in values:
        key, equals, content = value.partition("=")
        if not equals or key not in {p.name for p in known}:
            if known and known[0].name not in parsed and not equals:
                key, content = known[0].name, value  # a value without a key sets the first parameter: play text "hello"
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


def _follow_plan(client: "DaemonClient", plan: "Plan", wait: bool, as_json: bool) -> None:
    if wait and not plan.has_ended:
        plan = _wait_until_shown(client, plan.plan)
    if as_json:
        print_json(plan)
    else:
        for line in format_plan_summary(plan.summary):
            print(line)
        print(f"plan             {plan.plan}: {plan.status}")
        if plan.status == "done":
            print(f"executed         {plan.executed} of {plan.sent} sent, {plan.planned} planned")
    plan.raise_if_failed()


def _wait_until_shown(client: "DaemonClient", plan_id: str) -> "Plan":
    from optodrive.client.requests import build_read_request

    with show_progress("showing") as on_progress:
        while not (plan := client.call(build_read_request(plan_id, pulses=False))).has_ended:
            on_progress(plan.executed / max(1, plan.planned))
            time.sleep(POLL_S)
    return client.call(build_read_request(plan_id))
