"""Figures of the diagnosis report: measured values beside the models, residuals, and the bars of the evidence."""

from html import escape
from math import log10

import numpy as np

from optodrive.core.quantity import format_quantity
from optodrive.core.svg_plot import Axis, Series, draw_plot
from optodrive.core.types.discrepancy import ExampleTrace, ResidualTrace

QUANTITIES = {
    "absorber_temperature_K": "absorber above ambient",
    "displacement_m": "displacement",
    "force_N": "force",
    "mirror_x_rad": "mirror x",
    "mirror_y_rad": "mirror y",
}
TIME = Axis("time", "s")
TRACE_HEIGHT, RESIDUAL_HEIGHT = 230, 150
BAR_WIDTH, BAR_HEIGHT = 220, 26


def draw_example(example: ExampleTrace, has_extension: bool) -> str:
    """Draw a run's measured values with the models, and below them the residuals."""
    trace = example.trace
    unit = trace.signal.rsplit("_", 1)[1]
    quantity = QUANTITIES.get(trace.signal, trace.signal)
    title = f"{example.role} run of {trace.signal}: {trace.run}"
    series = [
        Series(trace.measured, "measured", is_dotted=True),
        Series(trace.compute_model(trace.nominal), "nominal"),
        *([Series(trace.compute_model(trace.extended), "extended")] if has_extension else []),
    ]
    caption = (
        f"{example.role.capitalize()} run of {trace.signal}: {trace.run} ({trace.group}); the nominal model is "
        f"{trace.rms_nominal:.1f} σ rms off, σ = {format_quantity(trace.sigma, unit)}"
    )
    plot = draw_plot(f"{title}, measured and model", trace.t_s, TIME, Axis(quantity, unit), series, TRACE_HEIGHT)
    residuals = draw_residual_plot(trace, has_extension, title)
    return f"<figure>{plot}{residuals}<figcaption>{escape(caption)}</figcaption></figure>"


def draw_residuals(trace: ResidualTrace, has_extension: bool) -> str:
    """Draw the residuals of a group."""
    caption = f"{trace.signal}, {trace.group}: nominal {_compute_rms(trace.nominal):.1f} σ rms"
    caption += f", extended {_compute_rms(trace.extended):.1f} σ" if has_extension else ""
    plot = draw_residual_plot(trace, has_extension, f"{trace.signal} of {trace.group}")
    return f"<figure>{plot}<figcaption>{escape(caption)}</figcaption></figure>"


def draw_residual_plot(trace: ResidualTrace, has_extension: bool, title: str) -> str:
    """Draw measured minus model over time, with a band of one σ of the noise on either side of zero."""
    axis = Axis("measured − model", trace.signal.rsplit("_", 1)[1], trace.sigma)
    series = [Series(trace.sigma * trace.nominal, "nominal")]
    if has_extension:
        series.append(Series(trace.sigma * trace.extended, "extended"))
    return draw_plot(f"{title}, residuals", trace.t_s, TIME, axis, series, RESIDUAL_HEIGHT)


def draw_bar(ratio: float, max_ratio: float, threshold: float, is_named: bool) -> str:
    """Draw a likelihood ratio as a bar on a logarithmic scale, with a line at the threshold."""
    scale = (BAR_WIDTH - 2) / log10(1.0 + max(max_ratio, 2.0 * threshold))
    width, line = (scale * log10(1.0 + max(0.0, value)) for value in (ratio, threshold))
    return (
        f"<svg class='bars' viewBox='0 0 {BAR_WIDTH} {BAR_HEIGHT}' style='width:{BAR_WIDTH}px' aria-hidden='true'>"
        f"<rect class='{'bar' if is_named else 'other'}' x='0' y='7' width='{width:.1f}' height='12'/>"
        f"<line class='threshold' x1='{line:.1f}' x2='{line:.1f}' y1='0' y2='{BAR_HEIGHT}'/></svg>"
    )


def draw_share(share: float) -> str:
    """Draw a share of one as a bar."""
    return (
        f"<svg class='bars' viewBox='0 0 {BAR_WIDTH} {BAR_HEIGHT}' style='width:{BAR_WIDTH}px' aria-hidden='true'>"
        f"<rect class='bar' x='0' y='7' width='{share * BAR_WIDTH:.1f}' height='12'/></svg>"
    )


def _compute_rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
