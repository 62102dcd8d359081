"""`optodrive push | play`: frames and named patterns to a running daemon, with labels of the request."""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Unpack

import typer

from optodrive.cli.invocation import exit_unless_fits
from optodrive.cli.options import (
    HoldOption,
    JsonOption,
    UrlOption,
)
from optodrive.cli.output import print_json, show_progress
from optodrive.cli.plan import format_plan_summary
from optodrive.cli.push_options import add_push_options, parse_parameters
from optodrive.cli.signals import end_as_interrupted
from optodrive.core.daemon_url import DEFAULT_URL
from optodrive.core.errors import InputError, OptodriveError
from optodrive.core.files import read_bounded
from optodrive.core.types.push_options import PushOptions

if TYPE_CHECKING:
    from optodrive.client.api_request import ApiRequest
    from optodrive.client.http import DaemonClient
    from optodrive.client.plan import Plan


LabelOption = Annotated[
    list[str] | None,
    typer.Option("--label", metavar="KEY=VALUE", help="Record this label with the plan; may be repeated."),
]


def parse_label_options(options: list[str]) -> dict[str, str | int | float | bool]:
    """Return labels. Numbers, true and false are values of their own. Raise InputError for one without a key."""
    from optodrive.planning.stimuli.json_values import parse_labels

    labels: dict[str, object] = {}
    for option in options:
        key, equals, text = option.partition("=")
        if not equals:
            raise InputError("--label", option, "KEY=VALUE")
        if key in labels:
            raise InputError("--label", option, "each key once")
        labels[key] = _convert(text)
    return parse_labels(labels, "--label")


def add_labels(source: str, body: bytes, options: list[str]) -> dict[str, object]:
    """Return the decoded body of FRAMES.json with labels, which replace those of the same key."""
    from optodrive.planning.stimuli.json_values import decode_json

    decoded = decode_json(body, source)
    if not isinstance(decoded, dict):
        raise InputError(source, decoded, "an object with frames, trains")
    own = decoded.get("labels", {})
    return {**decoded, "labels": {**(own if isinstance(own, dict) else {}), **parse_label_options(options)}}


def _convert(text: str) -> object:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return text
    return value if isinstance(value, bool | int | float) else text


POLL_S = 0.1
BODY = "body"
"""The daemon's name of a request's body in errors."""

DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Plan and limit only; do not show.")]
WaitOption = Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until the plan has been shown.")]


@add_push_options
def push(
    frames: Annotated[Path, typer.Argument(metavar="FRAMES.json", help="Frames and trains.")],
    url: UrlOption = DEFAULT_URL,
    dry_run: DryRunOption = False,
    wait: WaitOption = True,
    hold: HoldOption = False,
    label: LabelOption = None,
    json: JsonOption = False,
    **options: Unpack[PushOptions],
) -> None:
    """Plan frames and trains, show them, and report the executed pulses."""
    from optodrive.client.http import DaemonClient
    from optodrive.client.requests import build_push_request

    body = read_bounded(frames)
    content = add_labels(str(frames), body, label) if label else body
    request = build_push_request(content, options, dry_run)
    client = DaemonClient(url)
    with _hold_if(hold, client, dry_run, wait):
        with _name_source(frames):
            plan = _show(client, request, dry_run, wait)
        _report_plan(plan, json)
    exit_unless_fits(plan.summary.feasibility)


@add_push_options
def play(
    pattern: Annotated[str, typer.Argument(metavar="PATTERN", help="A name that `optodrive patterns` lists.")],
    values: Annotated[list[str] | None, typer.Argument(metavar="KEY=VALUE", help="Pattern parameters.")] = None,
    url: UrlOption = DEFAULT_URL,
    dry_run: DryRunOption = False,
    wait: WaitOption = True,
    hold: HoldOption = False,
    label: LabelOption = None,
    json: JsonOption = False,
    **options: Unpack[PushOptions],
) -> None:
    """Play a named pattern, for example: play text "hello" height_um=150."""
    from optodrive.client.http import DaemonClient
    from optodrive.client.requests import build_play_request

    parameters: dict[str, object] = {**parse_parameters("play", pattern, values or [])}
    if label:
        parameters["labels"] = parse_label_options(label)
    client = DaemonClient(url)
    request = build_play_request(pattern, parameters, options, dry_run)
    with _hold_if(hold, client, dry_run, wait):
        plan = _show(client, request, dry_run, wait)
        _report_plan(plan, json)
    exit_unless_fits(plan.summary.feasibility)


@contextmanager
def _name_source(path: Path) -> Iterator[None]:
    """Name the file in an InputError of the daemon, which knows only the request's body."""
    try:
        yield
    except InputError as error:
        if not error.where.startswith(BODY):
            raise
        raise InputError(f"{path}{error.where.removeprefix(BODY)}", error.value, error.expected, error.code) from None


def _hold_if(hold: bool, client: "DaemonClient", dry_run: bool, wait: bool) -> AbstractContextManager[object]:
    """Arm the board until the command ends, if `hold`."""
    if not hold:
        return nullcontext()
    if dry_run or not wait:
        other = "--dry-run" if dry_run else "--no-wait"
        raise InputError("--hold", other, "a command that shows a plan and waits for its end")
    from optodrive.client.hold import Hold

    return Hold(client.endpoint)


def _show(client: "DaemonClient", request: "ApiRequest[Plan]", dry_run: bool, wait: bool) -> "Plan":
    """Submit a plan and wait for its end, if `wait`. A signal that ends this ends the plan as well."""
    plan = None
    with end_as_interrupted():
        try:
            plan = client.call(request)
            return _wait_until_shown(client, plan.plan) if wait and not plan.has_ended else plan
        except KeyboardInterrupt:
            if not dry_run:
                _end_plan(client, plan)
            raise


def _end_plan(client: "DaemonClient", plan: "Plan | None") -> None:
    """End a plan, or stop the board if the daemon does not do so, or has not answered which plan it is. Say it."""
    from optodrive.client.requests import STOP, build_cancel_request

    if plan is not None:
        with suppress(OptodriveError):
            ended = client.call(build_cancel_request(plan.plan))
            print(f"optodrive: plan {ended.plan}: {ended.status}, {ended.executed} pulses executed", file=sys.stderr)
            return
    client.call(STOP)
    print("optodrive: the display was stopped, because the plan could not be ended alone", file=sys.stderr)


def _report_plan(plan: "Plan", as_json: bool) -> None:
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
    from optodrive.client.plan import report_loss
    from optodrive.client.requests import build_read_request

    with report_loss(plan_id), show_progress("showing") as on_progress:
        while not (plan := client.call(build_read_request(plan_id, pulses=False))).has_ended:
            on_progress(plan.executed / max(1, plan.planned))
            time.sleep(POLL_S)
        return client.call(build_read_request(plan_id))
