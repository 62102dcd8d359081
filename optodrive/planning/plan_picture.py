"""Picture of a plan as SVG: the path of the beam over the display, and the timeline of gate and mirrors."""

from html import escape

import numpy as np

from optodrive.core.quantity import format_quantity
from optodrive.core.svg_plot import Axis, Scale
from optodrive.core.types.arrays import FloatArray, IntArray
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.planned_sequence import PlannedSequence

WIDTH, MARGIN = 960, 16
LEFT = 64
"""Left end of the plotted areas, after the ticks' numbers."""
HEADER = 56
MAP_SIZE = 420
LANES = (("gate", 90), ("x", 70), ("y", 70))
"""Lanes of the timeline with their heights."""
LANE_GAP = 26
PULSES_MAX = 4000
"""Pulses beyond this number are not drawn: the picture says so."""
MIN_WIDTH = 0.6
"""Width of the shortest pulse that is drawn, so that it remains visible."""
STYLE = """
svg { color-scheme: light dark; --page: #fff; --panel: #f6f6f6; --ink: #1c1c1c; --muted: #565656; --grid: #e0e0e0;
 --cell: #cfcfcf; --light: #1460aa; --path: #b2480f; }
@media (prefers-color-scheme: dark) { svg { --page: #14161a; --panel: #1b1e23; --ink: #e9e9e9; --muted: #adb2b8;
 --grid: #30363d; --cell: #4a525b; --light: #74b4f5; --path: #f29a5c; } }
.page { fill: var(--page); } .panel { fill: var(--panel); }
text { font: 12px system-ui, sans-serif; fill: var(--muted); } .title { font-size: 17px; fill: var(--ink); }
.grid-line { stroke: var(--grid); } .cell { fill: none; stroke: var(--cell); } .reached { fill: var(--light); }
.path { fill: none; stroke: var(--path); stroke-width: 1; stroke-linejoin: round; } .start { fill: var(--page);
 stroke: var(--path); stroke-width: 2; } .end { fill: var(--path); } .pulse { fill: var(--light); }
.trimmed { fill: var(--path); } .mirror { fill: none; stroke: var(--path); stroke-width: 1.2; }
"""


def draw_plan(planned: PlannedSequence, display: DisplayModel) -> str:
    """Return an SVG document in the colours, light or dark, that its viewer prefers."""
    timeline_top = HEADER + MAP_SIZE + 54
    height = timeline_top + sum(size + LANE_GAP for _, size in LANES) + 22
    return (
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {height}' width='{WIDTH}' height='{height}' "
        f"role='img' aria-label='{escape(_describe(planned, display), quote=True)}'><style>{STYLE}</style>"
        f"<rect class='page' width='{WIDTH}' height='{height}'/>"
        f"<text class='title' x='{MARGIN}' y='30'>{escape(_describe(planned, display))}</text>"
        + _draw_map(planned, display)
        + _draw_legend(planned)
        + _draw_timeline(planned, display, timeline_top)
        + "</svg>\n"
    )


def _describe(planned: PlannedSequence, display: DisplayModel) -> str:
    count = len(planned.plan)
    drawn = f"; the first {PULSES_MAX} are drawn" if count > PULSES_MAX else ""
    return f"{display.config.name}: {count} pulses in {format_quantity(planned.duration_s, 's')}{drawn}"


# --- path over the display ----------------------------------------------------------------------------------------


def _draw_map(planned: PlannedSequence, display: DisplayModel) -> str:
    layout, section = display.layout, display.config.display
    half_m = float(max(np.abs(layout.x_m).max(), np.abs(layout.y_m).max())) + section.pitch_m
    bottom = HEADER + MAP_SIZE
    x_scale = Scale(Axis("x", "m"), -half_m, half_m, LEFT, LEFT + MAP_SIZE)
    y_scale = Scale(Axis("y", "m"), -half_m, half_m, bottom, HEADER)
    scale = MAP_SIZE / (2.0 * half_m)
    width, height = section.absorber_width_m * scale, section.absorber_height_m * scale
    peak_m = _peaks_m(planned, len(layout))
    highest_m = float(peak_m.max()) if len(peak_m) else 0.0
    cells = []
    for x, y, reached_m in zip(
        x_scale.place_all(layout.x_m).tolist(), y_scale.place_all(layout.y_m).tolist(), peak_m.tolist(), strict=True
    ):
        box = f"x='{x - width / 2:.1f}' y='{y - height / 2:.1f}' width='{width:.1f}' height='{height:.1f}'"
        if reached_m > 0.0:
            cells.append(f"<rect class='reached' {box} fill-opacity='{0.2 + 0.8 * reached_m / highest_m:.2f}'/>")
        cells.append(f"<rect class='cell' {box}/>")
    panel = f"<rect class='panel' x='{LEFT}' y='{HEADER}' width='{MAP_SIZE}' height='{MAP_SIZE}'/>"
    ticks = _draw_x_ticks(x_scale, HEADER, bottom) + _draw_y_ticks(y_scale, LEFT, LEFT + MAP_SIZE)
    labels = (
        f"<text x='{LEFT + MAP_SIZE}' y='{bottom + 32}' text-anchor='end'>{escape(x_scale.label)}</text>"
        f"<text x='{LEFT}' y='{HEADER - 6}'>{escape(y_scale.label)}</text>"
    )
    return panel + ticks + "".join(cells) + _draw_path(planned, display, x_scale, y_scale) + labels


def _draw_path(planned: PlannedSequence, display: DisplayModel, x_scale: Scale, y_scale: Scale) -> str:
    """Draw the path of every stage's beam."""
    plan, shown = planned.plan, slice(0, PULSES_MAX)
    return "".join(
        _draw_beam(plan.pixel[shown][plan.stage[shown] == stage], display, x_scale, y_scale)
        for stage in range(planned.stage_count)
    )


def _draw_beam(pixel: IntArray, display: DisplayModel, x_scale: Scale, y_scale: Scale) -> str:
    if not len(pixel):
        return ""
    x = x_scale.place_all(display.layout.x_m[pixel]).tolist()
    y = y_scale.place_all(display.layout.y_m[pixel]).tolist()
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return (
        f"<polyline class='path' points='{points}'/><circle class='end' cx='{x[-1]:.1f}' cy='{y[-1]:.1f}' r='3.5'/>"
        f"<circle class='start' cx='{x[0]:.1f}' cy='{y[0]:.1f}' r='4.5'/>"
    )


def _peaks_m(planned: PlannedSequence, count: int) -> FloatArray:
    """Return the largest predicted displacement of each pixel, [p]."""
    peak_m = np.zeros(count)
    np.maximum.at(peak_m, planned.plan.pixel, np.nan_to_num(planned.predicted_m))
    return peak_m


def _draw_legend(planned: PlannedSequence) -> str:
    plan, x = planned.plan, LEFT + MAP_SIZE + 44
    highest_m = float(np.nan_to_num(planned.predicted_m).max()) if len(plan) else 0.0
    trimmed = int(np.count_nonzero(plan.trimmed_j > 0.0))
    on_s = float(plan.width_s[plan.power_w > 0.0].sum())
    marks = (
        ("<circle class='start' cx='8' cy='-4' r='4.5'/>", "first pulse"),
        ("<circle class='end' cx='8' cy='-4' r='3.5'/>", "last pulse"),
        ("<line class='path' x1='0' x2='16' y1='-4' y2='-4'/>", "path of the beam, in order of the pulses"),
        ("<rect class='cell' x='2' y='-10' width='12' height='12'/>", "pixel that stays down"),
        ("<rect class='reached' x='2' y='-10' width='12' height='12'/>", f"up to {format_quantity(highest_m, 'm')}"),
        ("<rect class='pulse' x='5' y='-12' width='6' height='14'/>", "pulse, gate on"),
        ("<rect class='trimmed' x='5' y='-12' width='6' height='14'/>", f"trimmed pulse: {trimmed}"),
    )
    items = [
        f"<g transform='translate({x},{HEADER + 20 + 24 * row})'>{mark}<text x='26'>{escape(text)}</text></g>"
        for row, (mark, text) in enumerate(marks)
    ]
    beams = f"{planned.stage_count} × " if planned.stage_count > 1 else ""
    facts = (
        f"beam on {format_quantity(on_s, 's')} of {beams}{format_quantity(planned.duration_s, 's')}",
        f"{format_quantity(float(plan.energy_j.sum()), 'J')} incident",
    )
    top = HEADER + 40 + 24 * len(marks)
    return "".join(items) + "".join(
        f"<text x='{x}' y='{top + 20 * row}'>{escape(text)}</text>" for row, text in enumerate(facts)
    )


# --- timeline -----------------------------------------------------------------------------------------------------


def _draw_timeline(planned: PlannedSequence, display: DisplayModel, top: int) -> str:
    plan, right, parts = planned.plan, WIDTH - MARGIN, []
    shown = slice(0, PULSES_MAX)
    start_s, width_s, power_w = plan.start_s[shown], plan.width_s[shown], plan.power_w[shown]
    end_s = float((start_s + width_s).max(initial=0.0)) or 1.0
    time = Scale(Axis("time", "s"), 0.0, end_s, LEFT, right)
    positions_m = {"x": display.layout.x_m[plan.pixel[shown]], "y": display.layout.y_m[plan.pixel[shown]]}
    half_m = float(max(np.abs(display.layout.x_m).max(), np.abs(display.layout.y_m).max())) or 1e-3
    for name, size in LANES:
        bottom = top + size
        axis = Axis("gate: power", "W") if name == "gate" else Axis(f"beam at {name}", "m")
        low, high = (0.0, display.config.laser.max_power_w) if name == "gate" else (-half_m, half_m)
        scale = Scale(axis, low, high, bottom, top)
        parts.append(f"<rect class='panel' x='{LEFT}' y='{top}' width='{right - LEFT}' height='{size}'/>")
        parts.append(
            _draw_x_ticks(time, top, bottom, name == LANES[-1][0])
            + _draw_y_ticks(scale, LEFT, right, 2 if name == "gate" else 1)
        )
        parts.append(f"<text x='{LEFT}' y='{top - 6}'>{escape(scale.label)}</text>")
        if name == "gate":
            parts.append(_draw_pulses(start_s, width_s, power_w, plan.trimmed_j[shown], time, scale))
        else:
            for stage in range(planned.stage_count):
                own = plan.stage[shown] == stage
                parts.append(_draw_steps(start_s[own], width_s[own], positions_m[name][own], time, scale))
        top = bottom + LANE_GAP
    parts.append(f"<text x='{right}' y='{top + 8}' text-anchor='end'>{escape(time.label)}</text>")
    return "".join(parts)


def _draw_pulses(
    start_s: FloatArray, width_s: FloatArray, power_w: FloatArray, trimmed_j: FloatArray, time: Scale, scale: Scale
) -> str:
    left, right = time.place_all(start_s), time.place_all(start_s + width_s)
    return "".join(
        f"<rect class='{'trimmed' if trimmed > 0.0 else 'pulse'}' x='{a:.2f}' y='{scale.place(power):.1f}' "
        f"width='{max(b - a, MIN_WIDTH):.2f}' height='{scale.place(0.0) - scale.place(power):.1f}'/>"
        for a, b, power, trimmed in zip(
            left.tolist(), right.tolist(), power_w.tolist(), trimmed_j.tolist(), strict=True
        )
    )


def _draw_steps(start_s: FloatArray, width_s: FloatArray, at_m: FloatArray, time: Scale, scale: Scale) -> str:
    """Draw the commanded position: the mirrors leave when a pulse ends."""
    if not len(start_s):
        return ""
    begins = np.concatenate([[0.0], (start_s + width_s)[:-1]])
    x = time.place_all(np.column_stack([begins, start_s + width_s]).ravel())
    y = scale.place_all(np.repeat(at_m, 2))
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))
    return f"<polyline class='mirror' points='{points}'/>"


def _draw_x_ticks(scale: Scale, top: int, bottom: int, numbers: bool = True) -> str:
    lines = [f"<line class='grid-line' x1='{x:.1f}' x2='{x:.1f}' y1='{top}' y2='{bottom}'/>" for x, _ in scale.ticks]
    texts = [
        f"<text x='{x:.1f}' y='{bottom + 16}' text-anchor='middle'>{text.replace('-', '−')}</text>"
        for x, text in scale.ticks
    ]
    return "".join(lines + (texts if numbers else []))


def _draw_y_ticks(scale: Scale, left: int, right: int, every: int = 1) -> str:
    return "".join(
        f"<line class='grid-line' x1='{left}' x2='{right}' y1='{y:.1f}' y2='{y:.1f}'/>"
        f"<text x='{left - 6}' y='{y + 4:.1f}' text-anchor='end'>{text.replace('-', '−')}</text>"
        for y, text in scale.ticks[::every]
    )
