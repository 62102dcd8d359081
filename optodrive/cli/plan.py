"""`optodrive plan`: plan and limit frames without a daemon."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Unpack

import typer

from optodrive.cli.invocation import exit_unless_fits
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
from optodrive.cli.push_options import add_push_options
from optodrive.core.quantity import format_quantity, list_names
from optodrive.core.types.push_options import PushOptions

if TYPE_CHECKING:
    from optodrive.planning.feasibility.report import FeasibilityReport
    from optodrive.planning.summary_schema import DelaySummary, PlanSummary, ShortfallSummary


OMITTED_LISTED_MAX = 5
PIXELS_LISTED_MAX = 20
LATE_LISTED_MAX = 5
TRAINS_LISTED_MAX = 5


def format_plan_summary(summary: "PlanSummary") -> list[str]:
    """Format a plan's summary, one line per item."""
    early = f", steps sent {format_quantity(summary.early_step_s, 's')} early" if summary.early_step_s else ""
    galvo_pause = f", and {summary.galvo_pause_s:.1f} s of galvo pauses" if summary.galvo_pause_s else ""
    target = f", {summary.predicted_max_target_um:.1f} µm requested" if summary.predicted_max_target_um else ""
    pixel = "" if summary.predicted_max_pixel is None else f", at pixel {summary.predicted_max_pixel}"
    lines = [] if summary.feasibility is None else _format_feasibility(summary.feasibility)
    lines += [
        f"pulses           {summary.pulses}",
        f"duration         {summary.duration_s:.4f} s",
        f"beam on          {summary.beam_on_s:.4f} s, {100 * summary.beam_on_fraction:.1f} % of it",
        f"settling         {summary.settling_s:.4f} s{early}{galvo_pause}",
        f"energy           {summary.energy_j:.4f} J incident",
        f"highest          {summary.predicted_max_um:.1f} µm predicted{target}{pixel}",
        f"min headroom     {summary.headroom_min_k:.1f} K below the absorber cap",
    ]
    trimmed = summary.trimmed
    if trimmed.pulses:
        reasons = ", ".join(f"{count} by {reason}" for reason, count in trimmed.by_reason.items())
        lines.append(f"trimmed          {trimmed.pulses} pulses, {format_quantity(trimmed.energy_j, 'J')}: {reasons}")
        if summary.shortfall is not None:
            lines.append(f"                 {_format_shortfall(summary.shortfall)}")
    else:
        lines.append("trimmed          nothing")
    lines += [f"peaks            {train.message}" for train in summary.off_target.trains[:TRAINS_LISTED_MAX]]
    more = summary.off_target.count - TRAINS_LISTED_MAX
    if more > 0:
        lines.append(f"peaks            and those of {more} more trains")
    if summary.repeats is not None and summary.repeats.message:
        lines.append(f"intervals        {summary.repeats.message}")
    if summary.delays:
        lines.append(f"delayed          {_format_delays(summary.delays)}")
    lines += [f"late             {message}" for message in summary.late_messages[:LATE_LISTED_MAX]]
    more = len(summary.late_messages) - LATE_LISTED_MAX
    if more > 0:
        lines.append(f"late             and {more} more frames")
    if summary.train_lateness_max_s > 0:
        lines.append(
            f"trains           settling delays pulses by up to {format_quantity(summary.train_lateness_max_s, 's')}"
        )
    if summary.dead.message:
        lines.append(f"dead             {summary.dead.message}")
    if summary.skipped:
        lines.append(f"no pulse needed  {len(summary.skipped)} times: the heat left in the pixel reaches the target")
    return lines


def _format_feasibility(report: "FeasibilityReport") -> list[str]:
    if report.fits:
        return ["fits: yes" if report.proof == "planned" else f"fits: yes, {report.message}"]
    lines = [f"fits: no, {report.message}"]
    if report.fit == "even":
        lines.append(f"shown            all heights and powers × {report.height_factor:g}")
    for omission in report.omitted[:OMITTED_LISTED_MAX]:
        lines.append(f"omitted          {omission.name}: {_format_pixels(omission.pixels)}")
    more = len(report.omitted) - OMITTED_LISTED_MAX
    if more > 0:
        lines.append(f"omitted          and pixels of {more} more")
    return lines


def _format_pixels(pixels: Sequence[int]) -> str:
    return f"pixel{'s' if len(pixels) > 1 else ''} {list_names(pixels, PIXELS_LISTED_MAX)}"


def _format_shortfall(shortfall: "ShortfallSummary") -> str:
    fits = "never" if shortfall.fits_after_s is None else f"{shortfall.fits_after_s:.3f} s later"
    return f"first pixel {shortfall.pixel}, {format_quantity(shortfall.margin_j, 'J')} too much; all of it fits {fits}"


def _format_delays(delays: "Sequence[DelaySummary]") -> str:
    first, total_s = delays[0], sum(delay.wait_s for delay in delays)
    where = f"{first.source}, {first.wait_s:.3f} s for pixel {first.pixel} ({first.cap})"
    return f"{total_s:.3f} s in {len(delays)} frames or trains, first in {where}"


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
