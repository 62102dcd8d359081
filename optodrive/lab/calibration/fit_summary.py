"""What a fit says of itself: in numbers, and as two pictures."""

from typing import Any

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.calibration.field_fit import FieldFit

REGIONS = 3
PLACES = 9
"""Places a side at which sigma is looked at: three to each side of a region."""
SIDE, EDGE = 420, 20
ARROW = 0.07
"""Longest arrow, of the picture's side."""


def summary(fit: FieldFit) -> dict[str, Any]:
    """Figures for people and programs: µm on an axis unless they are lengths; rows counted from 0, as in the spots."""
    kept = np.hypot(*fit.residual_m[~fit.outlier].T)
    sigma_um = 1e6 * regions_m(fit)
    return {
        "spots": len(fit.spots),
        "outlier_rows": np.flatnonzero(fit.outlier).tolist(),
        "residual_rms_um": 1e6 * fit.rms_m if len(kept) else None,
        "residual_max_um": 1e6 * float(kept.max()) if len(kept) else None,
        "noise_um": 1e6 * fit.noise_m,
        "surface_um": 1e6 * fit.surface_m,
        "sigma_um": sigma_um.tolist(),
        "sigma_rms_um": 1e6 * sigma_rms_m(fit),
        "sigma_max_um": 1e6 * float(fit.field.sigma_m(*fit.prior.pixels.grid(PLACES)).max()),
    }


def regions_m(fit: FieldFit) -> FloatArray:
    """Sigma, rms over each region of the display, [REGIONS, REGIONS] with the top row first, m."""
    sigma_m = fit.field.sigma_m(*fit.prior.pixels.grid(PLACES)).reshape(REGIONS, PLACES // REGIONS, REGIONS, -1)
    rms_m: FloatArray = np.sqrt((sigma_m**2).mean(axis=(1, 3)))[::-1]
    return rms_m


def sigma_rms_m(fit: FieldFit) -> float:
    """Sigma, rms over the whole display, on an axis, m."""
    return float(np.sqrt((regions_m(fit) ** 2).mean()))


def quiver(fit: FieldFit) -> str:
    """SVG: what the fit leaves of each spot, as arrows where they lie; outliers as crosses."""
    x, y = _placed(fit, fit.spots.x_code, fit.spots.y_code)
    kept = ~fit.outlier
    longest_m = max(1e-9, float(np.hypot(*fit.residual_m[kept].T).max())) if kept.any() else 1.0
    dx, dy = (fit.residual_m * (ARROW * SIDE / longest_m)).T
    arrows = [
        f"<line x1='{a:.1f}' y1='{b:.1f}' x2='{a + da:.1f}' y2='{b - db:.1f}' class='after'/>"
        f"<circle cx='{a:.1f}' cy='{b:.1f}' r='1.5' class='bar'/>"
        for a, b, da, db, true in zip(x, y, dx, dy, kept, strict=True)
        if true
    ]
    crosses = [
        f"<text x='{a:.1f}' y='{b + 4:.1f}' text-anchor='middle' fill='#c2571a'>×<title>row {row}</title></text>"
        for row, (a, b, true) in enumerate(zip(x, y, kept, strict=True))
        if not true
    ]
    scale = f"<text x='{EDGE}' y='{SIDE - 4}'>longest arrow {1e6 * longest_m:.1f} µm; × taken for false</text>"
    return _svg("".join([*arrows, *crosses, scale]))


def heat_map(fit: FieldFit) -> str:
    """SVG: one sigma over the field, dark where it is large; each cell tells its number."""
    grid_um = 1e6 * fit.field.sigma_grid_m[::-1]
    size = (SIDE - 2 * EDGE) / len(grid_um)
    low, high = float(grid_um.min()), float(grid_um.max())
    cells = [
        f"<rect x='{EDGE + column * size:.1f}' y='{EDGE + row * size:.1f}' width='{size:.1f}' height='{size:.1f}' "
        f"fill='hsl(210,70%,{92 - 62 * (value - low) / max(high - low, 1e-9):.0f}%)'>"
        f"<title>{value:.1f} µm</title></rect>"
        for row, line in enumerate(grid_um.tolist())
        for column, value in enumerate(line)
    ]
    scale = f"<text x='{EDGE}' y='{SIDE - 4}'>{low:.1f} (light) to {high:.1f} µm (dark)</text>"
    return _svg("".join([*cells, scale]))


def _placed(fit: FieldFit, x_code: FloatArray, y_code: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Codes to places in the picture, y up."""
    room = 0.5 * SIDE - EDGE
    x_share, y_share = fit.field.extent.shares(x_code, y_code)
    return 0.5 * SIDE + room * x_share, 0.5 * SIDE - room * y_share


def _svg(content: str) -> str:
    return f"<svg viewBox='0 0 {SIDE} {SIDE}' role='img'>{content}</svg>"
