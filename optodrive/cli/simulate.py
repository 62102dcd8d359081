"""`optodrive simulate`: a plan on the simulated board, and what instruments would have measured."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optodrive.cli.options import (
    ConfigOption,
    FieldOption,
    JsonOption,
    MirrorsOption,
    ModelOption,
    PixelMapOption,
    announce_compilation,
    configured,
    print_json,
    progress,
    report_lines,
)
from optodrive.cli.plan import FramesArgument
from optodrive.core.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from optodrive.core.types.measurements import PixelTrace
    from optodrive.core.types.plans import ExecutedPulses
    from optodrive.device.config import Config
    from optodrive.link.simulator.true_pixels import PixelTruth
    from optodrive.physics.thermal_state import Heat
    from optodrive.planning.feasibility import Admission
    from optodrive.planning.pipeline import Display, Prepared

PIXELS_MAX = 16
"""Without --pixels, so many of the driven pixels are looked at, the tallest first."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("simulate")(simulate)


def simulate(
    frames: FramesArgument,
    out: Annotated[Path | None, typer.Option("--out", metavar="recording.h5", help="Write the recording.")] = None,
    pixels: Annotated[str | None, typer.Option("--pixels", metavar="0,1,…", help="Pixels to look at, or all.")] = None,
    dt: Annotated[float, typer.Option("--dt", metavar="SECONDS", help="Time between samples.")] = 1e-3,
    noise: Annotated[float, typer.Option("--noise", help="Instrument noise, in units of what each states.")] = 0.0,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the noise.")] = 0,
    config: ConfigOption = None,
    model: ModelOption = None,
    field: FieldOption = None,
    mirrors: MirrorsOption = None,
    pixels_map: PixelMapOption = None,
    truth: Annotated[
        Path | None,
        typer.Option("--truth", metavar="model.toml", help="What the simulated display really is; else as planned."),
    ] = None,
    pixel_seed: Annotated[
        int | None,
        typer.Option(
            "--pixel-seed", min=0, help="Pixels as drawn from this seed: gains, offsets and dead ones, not as planned."
        ),
    ] = None,
    near: Annotated[
        float | None,
        typer.Option("--near", metavar="SECONDS", help="Record each pixel only until so long after its own pulses."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Plan frames, run them on the simulated board, and measure what the pixels do."""
    from optodrive.link.simulator.traces import trace, trace_near
    from optodrive.link.simulator.true_pixels import PixelTruth
    from optodrive.link.simulator.virtual_run import execute
    from optodrive.planning.feasibility import admit
    from optodrive.planning.pipeline import Display
    from optodrive.planning.stimuli.sequence_file import load_sequence

    if not 1e-6 <= dt <= 1.0:
        raise InputError("--dt", dt, "a time between 1e-6 and 1 s")
    if not 0.0 <= noise <= 1000.0:
        raise InputError("--noise", noise, "a factor between 0 and 1000")
    if near is not None and not 1e-3 <= near <= 10.0:
        raise InputError("--near", near, "a time between 0.001 and 10 s")
    display = Display.of(configured(config, model, field, mirrors, pixels_map))
    drawn = None if pixel_seed is None else PixelTruth.drawn(pixel_seed, display.config)
    planned = truth is None and drawn is None
    real = display.heat_at_rest() if planned else _really(configured(config, truth or model), drawn)
    wanted = _wanted(pixels, len(display.layout))
    sequence = load_sequence(frames, display.config)
    announce_compilation()
    with progress("planning") as done:
        prepared, admission = admit(display, sequence, *display.at_rest(), progress=done)
    with progress("simulating") as done:
        executed = execute(display, prepared, done)
    hit = executed if drawn is None else drawn.hit(executed, display.config)
    looked_at = _tallest(prepared) if wanted is None else wanted
    traced = (
        [trace(real, hit, looked_at, dt)]
        if near is None
        else [trace_near(real, hit, pixel, dt, near) for pixel in looked_at]
    )
    if out is not None:
        _write(out, display, executed, traced, noise, seed)
    report = _report(display, prepared, admission, hit, traced, real)
    if json:
        print_json(report)
        return
    for line in report_lines(report["summary"]):
        print(line)
    print(f"executed         {report['executed']} of {report['planned']} planned")
    for item in report["pixels"]:
        print(
            f"pixel {item['pixel']:<10} {item['measured_max_um']:.1f} µm measured, {item['predicted_max_um']:.1f} µm "
            f"predicted, absorber up to {item['absorber_max_c']:.1f} °C"
        )
    if out is not None:
        print(f"written          {out}")


def _really(config: "Config", drawn: "PixelTruth | None") -> "Heat":
    """The display as it is: of the configuration's model, its pixels as drawn, or all alike; no map says what is."""
    from optodrive.device.pixel_map import without_map
    from optodrive.physics.parameters import display_pixels, load_parameters
    from optodrive.physics.thermal_state import heat_at_rest

    parameters = load_parameters(config.pixel_model.parameters)
    alike = display_pixels(without_map(config), parameters)
    return heat_at_rest(config, parameters, alike if drawn is None else drawn.pixels(alike))


def _wanted(pixels: str | None, count: int) -> list[int] | None:
    if pixels is None:
        return None
    if pixels == "all":
        return list(range(count))
    wanted = []
    for word in pixels.split(","):
        if not word.strip().isdigit() or int(word) >= count:
            raise InputError("--pixels", word, f"indices 0 to {count - 1}, separated by commas")
        wanted.append(int(word))
    return list(dict.fromkeys(wanted))


def _tallest(prepared: "Prepared") -> list[int]:
    order = prepared.plan.pixel[prepared.predicted_m.argsort()[::-1]]
    return sorted(list(dict.fromkeys(order.tolist()))[:PIXELS_MAX])


def _write(
    out: Path, display: "Display", executed: "ExecutedPulses", traced: "list[PixelTrace]", noise: float, seed: int
) -> None:
    """One recording of all traces; each with the pulses that fall into its time."""
    import numpy as np

    from optodrive.core.types.measurements import Measurement, Run
    from optodrive.device.pixel_map import map_of
    from optodrive.lab.recording import write_recording
    from optodrive.link.simulator.instruments import measure

    pulses = np.column_stack([executed.start_s, executed.width_s, executed.power_w, executed.pixel])
    known, random = map_of(display.config), np.random.default_rng(seed)
    aim_m = None if known is None else np.array([known.offset_x_m, known.offset_y_m])
    width_m = display.config.display.bridge_width_m
    runs: list[Run] = []
    for item in traced:
        within = (pulses[:, 0] + pulses[:, 1] >= item.t_s[0]) & (pulses[:, 0] <= item.t_s[-1])
        runs += measure(item, pulses[within], display.ambient_k, width_m, noise, random, aim_m).runs
    write_recording(out, Measurement(tuple(runs)))


def _report(
    display: "Display",
    prepared: "Prepared",
    admission: "Admission",
    executed: "ExecutedPulses",
    traced: "list[PixelTrace]",
    real: "Heat",
) -> dict[str, Any]:
    from optodrive.core.units import m_to_um
    from optodrive.planning.plan_summary import pulse_columns, summary

    columns = (executed.pixel, executed.start_s, executed.width_s, executed.power_w)
    simulated_m = real.copy().pulses(*columns).displacement_m
    return {
        "summary": summary(prepared, admission),
        "planned": len(prepared.plan),
        "executed": len(executed),
        "complete": executed.complete,
        "simulated_max_um": m_to_um(float(simulated_m.max())) if len(executed) else 0.0,
        "pixels": [
            {
                "pixel": pixel,
                "measured_max_um": m_to_um(float(item.displacement_m[:, column].max())),
                "predicted_max_um": m_to_um(_predicted_max_m(prepared, pixel)),
                "absorber_max_c": display.config.ambient_c + float(item.absorber_k[:, column].max()),
            }
            for item in traced
            for column, pixel in enumerate(item.pixel.tolist())
        ],
        "pulses": pulse_columns(prepared),
    }


def _predicted_max_m(prepared: "Prepared", pixel: int) -> float:
    of_pixel: np.ndarray[Any, Any] = prepared.predicted_m[prepared.plan.pixel == pixel]
    return float(of_pixel.max()) if len(of_pixel) else 0.0
