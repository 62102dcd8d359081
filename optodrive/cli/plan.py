"""`optodrive plan`: plan and limit without a daemon."""

from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import (
    ConfigOption,
    FieldOption,
    FitOption,
    JsonOption,
    MirrorsOption,
    ModelOption,
    PixelMapOption,
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
    field: FieldOption = None,
    mirrors: MirrorsOption = None,
    pixels_map: PixelMapOption = None,
    strict: StrictOption = False,
    policy: PolicyOption = "trim",
    fit: FitOption = "as_is",
    json: JsonOption = False,
) -> None:
    """Plan and limit frames: whether they fit, pulses, beam time, what was trimmed and why, predicted displacement."""
    from optodrive.planning.feasibility import admit
    from optodrive.planning.pipeline import Display, chosen
    from optodrive.planning.plan_summary import summary, write_plan_csv
    from optodrive.planning.stimuli.sequence_file import load_sequence

    display = Display.of(configured(config, model, field, mirrors, pixels_map))
    sequence = load_sequence(frames, display.config)
    announce_compilation()
    with progress("planning") as done:
        prepared, admission = admit(display, sequence, *display.at_rest(), chosen(policy, strict), done, fit)
    if out is not None:
        write_plan_csv(out, prepared, display)
    figures = summary(prepared, admission)
    if json:
        print_json(figures)
        return
    for line in report_lines(figures):
        print(line)
    if out is not None:
        print(f"written          {out}")
