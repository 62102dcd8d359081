"""`optodrive plan`: plan and limit without a daemon."""

from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import (
    ConfigOption,
    JsonOption,
    ModelOption,
    PolicyOption,
    StrictOption,
    announce_compilation,
    configured,
    print_json,
    progress,
    report_lines,
)

FramesArgument = Annotated[Path, typer.Argument(metavar="FRAMES.json", help="Frames and trains.")]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("plan")(plan)


def plan(
    frames: FramesArgument,
    out: Annotated[Path | None, typer.Option("--out", metavar="plan.csv", help="Write one row a pulse.")] = None,
    config: ConfigOption = None,
    model: ModelOption = None,
    strict: StrictOption = False,
    policy: PolicyOption = "trim",
    json: JsonOption = False,
) -> None:
    """Plan and limit frames: pulses, beam-on share, duration, what was trimmed and why, predicted displacement."""
    from optodrive.frames.files import load_sequence
    from optodrive.pipeline import Display, chosen, prepare
    from optodrive.summary import summary, write_plan_csv

    display = Display.of(configured(config, model))
    sequence = load_sequence(frames, display.config)
    announce_compilation()
    with progress("planning") as done:
        prepared = prepare(display, sequence, *display.at_rest(), chosen(policy, strict), done)
    if out is not None:
        write_plan_csv(out, prepared, display)
    figures = summary(prepared)
    if json:
        print_json(figures)
        return
    for line in report_lines(figures):
        print(line)
    if out is not None:
        print(f"written          {out}")
