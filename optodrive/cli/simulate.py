"""`optodrive simulate`: run a plan on the simulated board and write the simulated measurements."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

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
from optodrive.cli.plan import FramesArgument, format_plan_summary
from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optodrive.core.types.measurements import PixelTrace, Run
    from optodrive.core.types.plans import ExecutedPulses
    from optodrive.planning.display_model import DisplayModel
if TYPE_CHECKING:
    import numpy as np

    from optodrive.core.types.measurements import PixelTrace
    from optodrive.core.types.plans import ExecutedPulses
    from optodrive.physics.thermal_state import ThermalState
    from optodrive.planning.display_model import DisplayModel
    from optodrive.planning.feasibility.report import FeasibilityReport
    from optodrive.planning.planned_sequence import PlannedSequence


REPEATS_MAX = 100
GROUP_MAX = 200
"""Maximum number of characters of a group's name."""
DEFAULT_GROUP = "simulated"


class InstrumentSettings(NamedTuple):
    """Noise of the instruments as a factor of theirs, its seed, the number of repeats, and their group if stated."""

    noise: float
    seed: int
    repeats: int
    group: str | None

    def check(self, out: Path | None) -> None:
        """Raise InputError for a setting out of range, or that needs a recording.

        out: the recording
        """
        if not 0.0 <= self.noise <= 1000.0:
            raise InputError("--noise", self.noise, "a factor between 0 and 1000")
        if not 1 <= self.repeats <= REPEATS_MAX:
            raise InputError("--repeats", self.repeats, f"a number from 1 to {REPEATS_MAX}")
        if self.group is not None and not (0 < len(self.group) <= GROUP_MAX and self.group.isprintable()):
            raise InputError("--group", self.group, f"1 to {GROUP_MAX} printable characters")
        if out is None and self.repeats > 1:
            raise InputError("--repeats", self.repeats, "--out, the recording of the repeats")
        if out is None and self.group is not None:
            raise InputError("--group", self.group, "--out, the recording of the group")

    def name_group(self, pixel: int, pixel_count: int) -> str | None:
        """Return the group of a pixel's runs, None without repeats and name. Different pixels never share a group."""
        if self.group is None and self.repeats == 1:
            return None
        name = self.group or DEFAULT_GROUP
        return name if pixel_count == 1 else f"{name}, pixel {pixel}"

    def describe(self) -> list[str]:
        """Return the lines that state noise and repeats."""
        return [f"noise            {_describe_noise(self.noise)}"] + (
            [f"repeats          {self.repeats} of every run, each with its own noise"] if self.repeats > 1 else []
        )


def record_traces(
    out: Path,
    display: "DisplayModel",
    executed: "ExecutedPulses",
    traces: "list[PixelTrace]",
    instruments: InstrumentSettings,
    true_terms: "Sequence[str]",
) -> None:
    """Write one recording with a run per pixel and repeat, each with the pulses during the pixel's trace.

    true_terms: of the simulated display and its instruments
    """
    import numpy as np

    from optodrive.core.types.measurements import Measurement
    from optodrive.device.pixel_map import load_pixel_map
    from optodrive.lab.recording import write_recording
    from optodrive.link.simulator.simulated_optics import measure
    from optodrive.physics.terms import all_terms

    coupling = "AC" if any(all_terms()[key].removes_zero for key in true_terms) else "DC"
    pulses = np.column_stack([executed.start_s, executed.width_s, executed.power_w, executed.pixel])
    pixel_map, rng = load_pixel_map(display.config), np.random.default_rng(instruments.seed)
    aim_m = None if pixel_map is None else np.array([pixel_map.offset_x_m, pixel_map.offset_y_m])
    width_m, pixel_count = display.config.display.bridge_width_m, sum(len(item.pixel) for item in traces)
    runs: list[Run] = []
    for repeat in range(instruments.repeats):
        for item in traces:
            within = (pulses[:, 0] + pulses[:, 1] >= item.t_s[0]) & (pulses[:, 0] <= item.t_s[-1])
            measured = measure(item, pulses[within], display.ambient_k, width_m, instruments.noise, rng, aim_m).runs
            pixels = item.pixel.tolist()
            runs += [
                _label_run(run, repeat, instruments, instruments.name_group(pixel, pixel_count), coupling)
                for run, pixel in zip(measured, pixels, strict=True)
            ]
    write_recording(out, Measurement(tuple(runs)))


def _label_run(run: "Run", repeat: int, instruments: InstrumentSettings, group: str | None, coupling: str) -> "Run":
    """Return the run with the name of its repeat, with its group and with the coupling of its instruments."""
    name = run.name if instruments.repeats == 1 else f"{run.name}-repeat-{repeat + 1}"
    attributes = run.attributes | {"coupling": coupling} | ({} if group is None else {"group": group})
    return replace(run, name=name, attributes=attributes)


def _describe_noise(noise: float) -> str:
    from optodrive.link.simulator.simulated_optics import INSTRUMENT_SIGMA

    if noise == 0.0:
        return "none: the recording is exact, as no instrument's is"
    sigmas = (format_quantity(noise * sigma, name.rsplit("_", 1)[1]) for name, sigma in INSTRUMENT_SIGMA.items())
    return f"{', '.join(sigmas)} rms added to the recording; --noise 0: none"


PIXELS_RECORDED_MAX = 16
"""Maximum number of pixels recorded without --pixels; those with the highest displacements are selected."""


def simulate(
    frames: FramesArgument,
    out: Annotated[Path | None, typer.Option("--out", metavar="recording.h5", help="Write the recording.")] = None,
    pixels: Annotated[
        str | None,
        typer.Option(
            "--pixels",
            metavar="0,1,…",
            help=f"Pixels to record, or all; by default the {PIXELS_RECORDED_MAX} that rise highest.",
        ),
    ] = None,
    dt: Annotated[float, typer.Option("--dt", metavar="SECONDS", help="Time between samples.")] = 1e-3,
    noise: Annotated[
        float, typer.Option("--noise", help="Noise of the recording as a factor of the instruments'; 0: none.")
    ] = 1.0,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the noise.")] = 0,
    repeats: Annotated[
        int, typer.Option("--repeats", metavar="N", help="Record the experiment N times, each with its own noise.")
    ] = 1,
    group: Annotated[
        str | None,
        typer.Option("--group", metavar="NAME", help="Group of the runs; repeats of one experiment share one."),
    ] = None,
    config: ConfigOption = None,
    model: ModelOption = None,
    field: FieldOption = None,
    mirrors: MirrorsOption = None,
    pixel_map: PixelMapOption = None,
    truth: Annotated[
        Path | None,
        typer.Option("--truth", metavar="model.toml", help="Ground truth of the display; default: the planned model."),
    ] = None,
    pixel_seed: Annotated[
        int | None,
        typer.Option(
            "--pixel-seed", min=0, help="Sample gains, offsets and dead pixels of the simulated display from this seed."
        ),
    ] = None,
    post_pulse_s: Annotated[
        float | None,
        typer.Option(
            "--post-pulse",
            metavar="SECONDS",
            help="Record each pixel only around its own pulses, until this long after.",
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Plan frames, run them on the simulated board, and simulate the measurement of the pixels."""
    from optodrive.core.files import check_output
    from optodrive.lab.recording.storage import HDF5_SUFFIXES
    from optodrive.link.simulator.true_display import (
        GroundTruthPixels,
        build_true_display,
        compute_pixel_trace,
        compute_traces,
        select_true_terms,
    )
    from optodrive.link.simulator.virtual_run import execute
    from optodrive.planning.display_model import DisplayModel
    from optodrive.planning.feasibility.check import check_feasibility
    from optodrive.planning.stimuli.sequence_file import load_sequence

    if not 1e-6 <= dt <= 1.0:
        raise InputError("--dt", dt, "a time between 1e-6 and 1 s")
    instruments = InstrumentSettings(noise, seed, repeats, group)
    instruments.check(out)
    if post_pulse_s is not None and not 1e-3 <= post_pulse_s <= 10.0:
        raise InputError("--post-pulse", post_pulse_s, "a time between 0.001 and 10 s")
    check_output("--out", out, *HDF5_SUFFIXES, folder=True)
    display = DisplayModel.from_config(load_run_config(config, model, field, mirrors, pixel_map))
    sampled_pixels = None if pixel_seed is None else GroundTruthPixels.sample(pixel_seed, display.config)
    is_nominal = truth is None and sampled_pixels is None
    true_terms, ignored_terms = select_true_terms(load_run_config(config, truth or model), truth)
    true_display = (
        display.build_cold_heat()
        if is_nominal
        else build_true_display(load_run_config(config, truth or model), sampled_pixels, true_terms)
    )
    selected = _parse_pixels(pixels, len(display.layout))
    sequence = load_sequence(frames, display.config)
    announce_compilation()
    with show_progress("planning") as on_progress:
        planned_sequence, feasibility = check_feasibility(
            display, sequence, *display.build_cold_state(), on_progress=on_progress
        )
    with show_progress("simulating") as on_progress:
        executed = execute(display, planned_sequence, on_progress)
    incident = executed if sampled_pixels is None else sampled_pixels.attenuate(executed, display.config)
    recorded = _select_highest(planned_sequence) if selected is None else selected
    traces = (
        [compute_traces(true_display, incident, recorded, dt)]
        if post_pulse_s is None
        else [compute_pixel_trace(true_display, incident, pixel, dt, post_pulse_s) for pixel in recorded]
    )
    if out is not None:
        record_traces(out, display, executed, traces, instruments, true_terms)
    report = _build_report(display, planned_sequence, feasibility, incident, traces, true_display)
    report["truth"] = {"terms": true_terms, "ignored_terms": ignored_terms}
    report |= {"noise": None if out is None else noise, "repeats": repeats, "group": group}
    written = [] if out is None else [*instruments.describe(), *list_written(out)]
    print_answer(report, [*_format_report(report, truth, selected is None), *written], json)
    exit_unless_fits(feasibility)


def _format_report(report: dict[str, Any], truth: Path | None, is_default: bool) -> Iterator[str]:
    """Yield the lines of a report. is_default: whether no option chose the recorded pixels."""
    yield from format_plan_summary(report["summary"])
    if truth is not None:
        terms, ignored = report["truth"]["terms"], report["truth"]["ignored_terms"]
        yield f"truth            {', '.join(terms) or 'the nominal pixel, without terms'}"
        if ignored:
            yield f"                 not simulated: {', '.join(ignored)} of its base set (not in planner_terms)"
    yield f"executed         {report['executed']} of {report['planned']} planned"
    recorded, driven = len(report["pixels"]), report["driven_pixels"]
    if is_default and recorded < driven:
        yield f"recorded         {recorded} of {driven} driven pixels; --pixels names others, or all"
    for item in report["pixels"]:
        yield (
            f"pixel {item['pixel']:<10} {item['measured_max_um']:.1f} µm measured, {item['predicted_max_um']:.1f} µm "
            f"predicted, absorber up to {item['absorber_max_c']:.1f} °C"
        )


def _parse_pixels(pixels: str | None, count: int) -> list[int] | None:
    if pixels is None:
        return None
    if pixels == "all":
        return list(range(count))
    selected = []
    for word in pixels.split(","):
        if not word.strip().isdigit() or int(word) >= count:
            raise InputError("--pixels", word, f"indices 0 to {count - 1}, separated by commas")
        selected.append(int(word))
    return list(dict.fromkeys(selected))


def _select_highest(planned_sequence: "PlannedSequence") -> list[int]:
    order = planned_sequence.plan.pixel[planned_sequence.predicted_m.argsort()[::-1]]
    return sorted(list(dict.fromkeys(order.tolist()))[:PIXELS_RECORDED_MAX])


def _build_report(
    display: "DisplayModel",
    planned_sequence: "PlannedSequence",
    feasibility: "FeasibilityReport",
    executed: "ExecutedPulses",
    traces: "list[PixelTrace]",
    true_display: "ThermalState",
) -> dict[str, Any]:
    from optodrive.core.quantity import m_to_um
    from optodrive.planning.plan_summary import summarize_plan
    from optodrive.planning.pulse_table import PulseTable

    columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
    pulses = PulseTable.from_planned(planned_sequence)
    simulated_m = true_display.copy().apply_pulses(*columns).displacement_m
    return {
        "summary": summarize_plan(planned_sequence, feasibility),
        "planned": len(planned_sequence.plan),
        "executed": len(executed),
        "complete": executed.complete,
        "driven_pixels": len(set(planned_sequence.plan.pixel.tolist())),
        "simulated_max_um": m_to_um(float(simulated_m.max())) if len(executed) else 0.0,
        "pixels": [
            {
                "pixel": pixel,
                "measured_max_um": m_to_um(float(item.displacement_m[:, column].max())),
                "predicted_max_um": m_to_um(_predicted_max_m(planned_sequence, pixel)),
                "absorber_max_c": display.config.ambient_c + float(item.absorber_k[:, column].max()),
            }
            for item in traces
            for column, pixel in enumerate(item.pixel.tolist())
        ],
        "pulses": None if pulses is None else pulses.to_columns(),
    }


def _predicted_max_m(planned_sequence: "PlannedSequence", pixel: int) -> float:
    displacement_m: np.ndarray[Any, Any] = planned_sequence.predicted_m[planned_sequence.plan.pixel == pixel]
    return float(displacement_m.max()) if len(displacement_m) else 0.0
