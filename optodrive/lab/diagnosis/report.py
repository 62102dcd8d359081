"""Diagnosis report: one self-contained HTML file built from the same data as the answer."""

from html import escape

import numpy as np

from optodrive.core.html_page import render_page, render_table
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import Discrepancy, ResidualTrace
from optodrive.lab.diagnosis.narrative import build_narrative, format_quantity

FIGURE_WIDTH, FIGURE_HEIGHT, MARGIN = 320, 150, 26
MAX_TRACES = 24
MAX_BARS = 14


def build_report(discrepancy: Discrepancy, title: str) -> str:
    """Return the report as HTML."""
    nominal = "<span style='color:#c2571a'>nominal model</span>"
    legend, name = (
        (f"{nominal}, <span style='color:#1a6fc2'>extended model</span>", "extended model")
        if discrepancy.terms
        else (nominal, "nominal model")
    )
    parts = [
        "<h2>Evidence for each cause</h2>",
        _draw_bars(discrepancy),
        "<h2>Parameters</h2>",
        _build_parameter_table(discrepancy),
        "<h2>Residuals by experiment, in units of the noise of one sample</h2>",
        f"<p>{legend}</p>",
        "<div class='grid'>",
        *(_draw_residuals(trace, bool(discrepancy.terms)) for trace in _select_traces(discrepancy.residual_traces)),
        "</div>",
        f"<h2>Predicted against measured, {name}</h2><div class='grid'>",
        *(
            _draw_scatter(signal, discrepancy.residual_traces)
            for signal in dict.fromkeys(trace.signal for trace in discrepancy.residual_traces)
        ),
        "</div>",
    ]
    return render_page(title, discrepancy.verdict, build_narrative(discrepancy), parts)


def _select_traces(traces: tuple[ResidualTrace, ...]) -> list[ResidualTrace]:
    return sorted(traces, key=lambda item: -float((item.nominal**2).mean()))[:MAX_TRACES]


def _draw_polyline(x: FloatArray, y: FloatArray, limits: tuple[float, float, float, float], css_class: str) -> str:
    left, right, low, high = limits
    across = MARGIN + (x - left) / max(right - left, 1e-12) * (FIGURE_WIDTH - MARGIN - 6)
    up = FIGURE_HEIGHT - 18 - (y - low) / max(high - low, 1e-12) * (FIGURE_HEIGHT - 26)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, up, strict=True))
    return f"<polyline class='{css_class}' points='{points}'/>"


def _draw_residuals(trace: ResidualTrace, extended: bool) -> str:
    max_residual = float(max(np.abs(trace.nominal).max(), np.abs(trace.extended).max(), 1.0))
    limits = (float(trace.t_s[0]), float(trace.t_s[-1]), -max_residual, max_residual)
    end = format_quantity(float(trace.t_s[-1]), "s")
    lines = _draw_polyline(trace.t_s, trace.nominal, limits, "nominal")
    lines += _draw_polyline(trace.t_s, trace.extended, limits, "extended") if extended else ""
    return (
        f"<figure><svg viewBox='0 0 {FIGURE_WIDTH} {FIGURE_HEIGHT}' role='img'>{lines}"
        f"<text x='2' y='14'>{max_residual:.1f} σ</text><text x='2' y='{FIGURE_HEIGHT - 20}'>−{max_residual:.1f}</text>"
        f"<text x='{FIGURE_WIDTH - 60}' y='{FIGURE_HEIGHT - 4}'>{end}</text></svg>"
        f"<figcaption>{escape(trace.signal)}, {escape(trace.group)}</figcaption></figure>"
    )


def _draw_scatter(signal: str, traces: tuple[ResidualTrace, ...]) -> str:
    signal_traces = [trace for trace in traces if trace.signal == signal]
    measured = np.concatenate([trace.measured for trace in signal_traces])
    scale = float(np.ptp(measured)) or 1.0
    noise = np.concatenate([trace.extended for trace in signal_traces])
    unit = signal.rsplit("_", 1)[1]
    # Residuals are in units of sigma.
    sigma = float(signal_traces[0].sigma)
    predicted = measured - noise * sigma
    low, high = float(measured.min()), float(measured.max())
    x = MARGIN + (predicted - low) / scale * (FIGURE_WIDTH - MARGIN - 6)
    y = FIGURE_HEIGHT - 18 - (measured - low) / scale * (FIGURE_HEIGHT - 26)
    dots = "".join(
        f"<circle cx='{a:.1f}' cy='{b:.1f}' r='1' class='bar'/>" for a, b in zip(x[::3], y[::3], strict=True)
    )
    ends = np.array([low, high])
    return (
        f"<figure><svg viewBox='0 0 {FIGURE_WIDTH} {FIGURE_HEIGHT}' role='img'>"
        f"{_draw_polyline(ends, ends, (low, high, low, high), 'nominal')}{dots}"
        f"<text x='{MARGIN}' y='{FIGURE_HEIGHT - 4}'>{format_quantity(low, unit)}</text>"
        f"<text x='{FIGURE_WIDTH - 70}' y='{FIGURE_HEIGHT - 4}'>{format_quantity(high, unit)}</text></svg>"
        f"<figcaption>{escape(signal)}: measured (vertical) against predicted</figcaption></figure>"
    )


def _draw_bars(discrepancy: Discrepancy) -> str:
    strongest = sorted(discrepancy.candidates, key=lambda item: -item.statistic)[:MAX_BARS]
    max_log_ratio = max([np.log10(1.0 + item.statistic) for item in strongest], default=1.0) or 1.0
    rows = []
    for item in strongest:
        width = 260 * np.log10(1.0 + item.statistic) / max_log_ratio
        css_class = "bar" if item.verdict in ("identified", "indistinguishable") else "other"
        bar = (
            "<svg viewBox='0 0 262 14' style='width:262px;border:0'>"
            f"<rect class='{css_class}' x='0' y='2' width='{width:.1f}' height='10'/></svg>"
        )
        rows.append((escape(item.label), bar, f"{item.statistic:.0f}", escape(item.verdict)))
    return render_table(("cause", "likelihood ratio (log scale)", "", ""), rows, frozenset({2}))


def _build_parameter_table(discrepancy: Discrepancy) -> str:
    rows = (
        (escape(name), format_quantity(item.value, item.unit), "limit of the range, no estimate", "")
        if item.at_limit
        else (escape(name), *(format_quantity(value, item.unit) for value in (item.value, item.low, item.high)))
        for name, item in discrepancy.parameters.items()
    )
    return render_table(("parameter", "value", "95 % from", "to"), rows, frozenset({1, 2, 3}))
