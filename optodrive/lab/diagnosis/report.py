"""The report: one HTML file that needs nothing beside itself. Numbers come from the answer, pictures from numbers."""

from html import escape

import numpy as np

from optodrive.core.html_page import page, table
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.discrepancy import Course, Discrepancy
from optodrive.lab.diagnosis.narrative import quantity, story

WIDTH, HEIGHT, EDGE = 320, 150, 26
SHOWN = 24
BARS = 14


def report(found: Discrepancy, title: str) -> str:
    """HTML."""
    nominal = "<span style='color:#c2571a'>nominal model</span>"
    lines, name = (
        (f"{nominal}, <span style='color:#1a6fc2'>extended model</span>", "extended model")
        if found.terms
        else (nominal, "nominal model")
    )
    parts = [
        "<h2>Evidence for each cause</h2>",
        _bars(found),
        "<h2>Numbers</h2>",
        _numbers(found),
        "<h2>Residuals by experiment, in units of the noise of one sample</h2>",
        f"<p>{lines}</p>",
        "<div class='grid'>",
        *(_residuals(course, bool(found.terms)) for course in _telling(found.courses)),
        "</div>",
        f"<h2>Predicted against measured, {name}</h2><div class='grid'>",
        *(_against(signal, found.courses) for signal in dict.fromkeys(course.signal for course in found.courses)),
        "</div>",
    ]
    return page(title, found.verdict, story(found), parts)


def _telling(courses: tuple[Course, ...]) -> list[Course]:
    return sorted(courses, key=lambda item: -float((item.before**2).mean()))[:SHOWN]


def _line(x: FloatArray, y: FloatArray, span: tuple[float, float, float, float], kind: str) -> str:
    left, right, low, high = span
    across = EDGE + (x - left) / max(right - left, 1e-12) * (WIDTH - EDGE - 6)
    up = HEIGHT - 18 - (y - low) / max(high - low, 1e-12) * (HEIGHT - 26)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, up, strict=True))
    return f"<polyline class='{kind}' points='{points}'/>"


def _residuals(course: Course, extended: bool) -> str:
    most = float(max(np.abs(course.before).max(), np.abs(course.after).max(), 1.0))
    span = (float(course.t_s[0]), float(course.t_s[-1]), -most, most)
    lines = _line(course.t_s, course.before, span, "before")
    lines += _line(course.t_s, course.after, span, "after") if extended else ""
    return (
        f"<figure><svg viewBox='0 0 {WIDTH} {HEIGHT}' role='img'>{lines}"
        f"<text x='2' y='14'>{most:.1f} σ</text><text x='2' y='{HEIGHT - 20}'>−{most:.1f}</text>"
        f"<text x='{WIDTH - 60}' y='{HEIGHT - 4}'>{quantity(float(course.t_s[-1]), 's')}</text></svg>"
        f"<figcaption>{escape(course.signal)}, {escape(course.group)}</figcaption></figure>"
    )


def _against(signal: str, courses: tuple[Course, ...]) -> str:
    own = [course for course in courses if course.signal == signal]
    measured = np.concatenate([course.measured for course in own])
    scale = float(np.ptp(measured)) or 1.0
    noise = np.concatenate([course.after for course in own])
    unit = signal.rsplit("_", 1)[1]
    # The residual is in σ; its size in the signal's unit follows from the courses themselves.
    sigma = float(own[0].sigma)
    predicted = measured - noise * sigma
    low, high = float(measured.min()), float(measured.max())
    x = EDGE + (predicted - low) / scale * (WIDTH - EDGE - 6)
    y = HEIGHT - 18 - (measured - low) / scale * (HEIGHT - 26)
    dots = "".join(
        f"<circle cx='{a:.1f}' cy='{b:.1f}' r='1' class='bar'/>" for a, b in zip(x[::3], y[::3], strict=True)
    )
    ends = np.array([low, high])
    return (
        f"<figure><svg viewBox='0 0 {WIDTH} {HEIGHT}' role='img'>"
        f"{_line(ends, ends, (low, high, low, high), 'before')}{dots}"
        f"<text x='{EDGE}' y='{HEIGHT - 4}'>{quantity(low, unit)}</text>"
        f"<text x='{WIDTH - 70}' y='{HEIGHT - 4}'>{quantity(high, unit)}</text></svg>"
        f"<figcaption>{escape(signal)}: measured (up) against predicted</figcaption></figure>"
    )


def _bars(found: Discrepancy) -> str:
    shown = sorted(found.candidates, key=lambda item: -item.statistic)[:BARS]
    most = max([np.log10(1.0 + item.statistic) for item in shown], default=1.0) or 1.0
    rows = []
    for item in shown:
        width = 260 * np.log10(1.0 + item.statistic) / most
        kind = "bar" if item.verdict in ("named", "cannot be told apart") else "other"
        bar = (
            "<svg viewBox='0 0 262 14' style='width:262px;border:0'>"
            f"<rect class='{kind}' x='0' y='2' width='{width:.1f}' height='10'/></svg>"
        )
        rows.append((escape(item.label), bar, f"{item.statistic:.0f}", escape(item.verdict)))
    return table(("cause", "likelihood ratio (log scale)", "", ""), rows, frozenset({2}))


def _numbers(found: Discrepancy) -> str:
    rows = (
        (escape(name), *(quantity(value, item.unit) for value in (item.value, item.low, item.high)))
        for name, item in found.parameters.items()
    )
    return table(("parameter", "value", "95 % from", "to"), rows, frozenset({1, 2, 3}))
