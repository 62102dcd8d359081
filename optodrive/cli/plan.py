"""`optodrive plan`: plan and limit frames without a daemon."""

from pathlib import Path
from typing import Annotated, Unpack

import typer

from optodrive.cli.exit_status import exit_unless_fits
from optodrive.cli.options import (
    ConfigOption,
    FieldOption,
    JsonOption,
    MirrorsOption,
    ModelOption,
    PixelMapOption,
    load_run_config,
)
from optodrive.cli.output import announce_compilation, list_written, print_answer, show_progress
from optodrive.cli.plan_text import format_plan_summary
from optodrive.cli.push_options import add_push_options
from optodrive.core.types.push_options import PushOptions

FramesArgument = Annotated[Path, typer.Argument(metavar="FRAMES.json", help="Frames and trains.")]


@add_push_options
def plan(
    frames: FramesArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="plan.csv|.svg", help="Write one row per pulse, or a picture of path and timeline."
        ),
    ] = None,
    config: ConfigOption = None,
    model: ModelOption = None,
    field: FieldOption = None,
    mirrors: MirrorsOption = None,
    pixel_map: PixelMapOption = None,
    json: JsonOption = False,
    **options: Unpack[PushOptions],
) -> None:
    """Plan and limit frames. Report feasibility, pulses, beam time, trimmed pulses and predicted displacement."""
    from optodrive.core.files import check_output, write_text
    from optodrive.planning.display_model import DisplayModel
    from optodrive.planning.feasibility.check import check_feasibility
    from optodrive.planning.plan_summary import summarize_plan, write_plan_csv
    from optodrive.planning.stimuli.sequence_file import load_sequence

    check_output("--out", out, ".csv", ".svg")
    display = DisplayModel.from_config(load_run_config(config, model, field, mirrors, pixel_map))
    sequence = load_sequence(frames, display.config)
    announce_compilation()
    with show_progress("planning") as on_progress:
        planned_sequence, feasibility = check_feasibility(
            display, sequence, *display.build_cold_state(), on_progress, **options
        )
    if out is not None:
        if out.suffix.lower() == ".svg":
            from optodrive.planning.plan_picture import draw_plan

            write_text(out, draw_plan(planned_sequence, display))
        else:
            write_plan_csv(out, planned_sequence, display)
    document = summarize_plan(planned_sequence, feasibility)
    print_answer(document, [*format_plan_summary(document), *list_written(out)], json)
    exit_unless_fits(feasibility)
