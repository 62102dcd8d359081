"""A dry run never emits, by whichever way it comes to a daemon whose board is armed. The board's log is the witness.

The ways are found, not listed: the routes, the client's methods and the commands that have a dry run.
"""

import asyncio
import inspect
import json
import os

import pytest
from typer.main import get_command

from board_fixtures import board_disarmed, daemon_disarmed, kept  # noqa: F401 - fixtures
from forked_process import OPTODRIVE, run_process
from optodrive.cli.commands import build_app
from optodrive.client import AsyncDisplay, Display, operations
from optodrive.core.errors import InputError
from rig import TOKEN

FRAMES = {"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"200": 50}}]}
ARGUMENTS = {"show": ({200: 50.0},), "push": (FRAMES,), "play": ("pixel",)}
BODIES = {"POST /v1/plans": FRAMES, "POST /v1/patterns/{name}": {"pixel": 200}}
MISSPELT = ["dry-run=true", "dryrun=true", "Dry_Run=true", "dry_run=maybe", "dry_run=", "dry_run=true&dry_run=false"]


def list_routes(daemon):
    """List the routes that have a dry run, from the daemon's own document."""
    for path, methods in daemon.call("GET", "/openapi.json")["paths"].items():
        for method, operation in methods.items():
            if "dry_run" in {parameter["name"] for parameter in operation.get("parameters", ())}:
                yield f"{method.upper()} {path}"


def list_methods(kind):
    """List the methods of a display that have a dry run."""
    methods = inspect.getmembers(kind, inspect.isfunction)
    return [name for name, method in methods if "dry_run" in inspect.signature(method).parameters]


def list_dry_commands():
    """List the commands that have a dry run."""
    commands = get_command(build_app()).commands.items()
    return [name for name, each in commands if any("--dry-run" in option.opts for option in each.params)]


def run_over_rest(daemon, folder):
    routes = list(list_routes(daemon))
    assert routes == list(BODIES)
    for route in routes:
        method, path = route.replace("{name}", "pixel").split()
        plan = daemon.call(method, f"{path}?dry_run=true", json=BODIES[route])
        assert (plan["status"], plan["sent"]) == ("planned", 0)
        for query in [*MISSPELT, "polcy=refuse", "polcy=refuse&dry_run=true"]:
            daemon.call(method, f"{path}?{query}", status=422, json=BODIES[route])
        daemon.call(method, path, status=422, json={**BODIES[route], "dry_run": True})


def run_by_the_client(daemon, folder):
    names = list_methods(Display)
    assert sorted(names) == sorted(ARGUMENTS)
    with Display(daemon.url, TOKEN) as display:
        for name in names:
            plan = getattr(display, name)(*ARGUMENTS[name], dry_run=True)
            assert (plan.status, plan.sent) == ("planned", 0)
            for wrong in ({"dry_run": "false"}, *([] if name == "play" else [{"dryrun": True}, {"polcy": "refuse"}])):
                with pytest.raises(InputError):
                    getattr(display, name)(*ARGUMENTS[name], **wrong)
        assert not display._operations.may_emit


def run_by_the_async_client(daemon, folder):
    async def session():
        async with AsyncDisplay(daemon.url, TOKEN) as display:
            for name in list_methods(Display):
                plan = await getattr(display, name)(*ARGUMENTS[name], dry_run=True)
                assert (plan.status, plan.sent) == ("planned", 0)
                with pytest.raises(InputError):
                    await getattr(display, name)(*ARGUMENTS[name], dry_run="false")

    asyncio.run(session())


def run_by_commands(daemon, folder):
    path = folder / "frames.json"
    path.write_text(json.dumps(FRAMES))
    arguments = {"push": [str(path)], "play": ["pixel"]}
    names = list_dry_commands()
    assert sorted(names) == sorted(arguments)
    environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN}

    def run(name, *options):
        command = [OPTODRIVE, name, *arguments[name], "--url", daemon.url, *options]
        return run_process(command, capture_output=True, text=True, env=environment)

    for name in names:
        done = run(name, "--dry-run", "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["sent"] == 0
        for wrong in ("--dry_run", "--dryrun"):
            done = run(name, wrong)
            assert done.returncode == 2
            assert "--dry-run" in done.stderr.partition(wrong)[2]


def count_pulses_after(run, board, daemon, folder):
    """Return the pulses in the board's log after dry runs, and those of one push behind them, which ends the wait.

    What a dry run had queued would have been executed before that push.
    """
    daemon.arm()
    run(daemon, folder)
    assert daemon.board_state() in ("ARMED", "RUNNING")
    plan = daemon.finished(daemon.call("POST", "/v1/plans", json=FRAMES)["plan"])
    return len(board.of("pulse")), plan["executed"]


@pytest.mark.parametrize("run", [run_over_rest, run_by_the_client, run_by_the_async_client, run_by_commands])
def test_a_dry_run_emits_nothing(run, board, daemon, tmp_path):
    emitted, pushed = count_pulses_after(run, board, daemon, tmp_path)
    assert emitted == pushed == 1


@pytest.mark.parametrize("run", [run_by_the_client, run_by_the_async_client])
def test_a_dry_run_that_is_dropped_on_the_way_is_seen(run, board, daemon, tmp_path, monkeypatch):
    """Mutant: a client that builds its requests without the dry run that it was asked for."""
    for name in ("build_push_request", "build_play_request"):
        build = getattr(operations, name)
        monkeypatch.setattr(operations, name, lambda *arguments, build=build: build(*arguments[:-1], False))

    def ignore_reports(daemon, folder):
        with pytest.raises(AssertionError):
            run(daemon, folder)

    emitted, pushed = count_pulses_after(ignore_reports, board, daemon, tmp_path)
    assert emitted > pushed == 1


@pytest.mark.parametrize("wrong", ["dryrun", "dry_runn", "polcy", "labls"])
def test_a_misspelt_keyword_of_play_is_no_parameter_of_the_pattern(wrong, board, daemon):
    """The daemon knows the parameters, so that it refuses the request, and the client the keywords."""
    daemon.arm()
    nearest = r"expected a known parameter, .*; of the keywords of play, nearest is '(dry_run|policy|labels)'"
    with Display(daemon.url, TOKEN) as display, pytest.raises(InputError, match=nearest) as refused:
        display.play("pixel", **{wrong: True})
    assert refused.value.problem["code"] == "unknown_parameter"
    assert not board.of("pulse")
