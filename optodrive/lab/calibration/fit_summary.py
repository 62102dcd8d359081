"""Summary of a field fit in numbers and in two SVG figures."""

from typing import Any

import numpy as np

from optodrive.core.types.arrays import FloatArray
from optodrive.lab.calibration.field_fit import FieldFit

REGIONS_PER_SIDE = 3
SAMPLES_PER_SIDE = 9
"""Samples of sigma per side of the display: three per side of a region."""
PICTURE_SIDE, PICTURE_MARGIN = 420, 20
ARROW_FRACTION_MAX = 0.07
"""Length of the longest arrow, as a fraction of the figure's side."""


def summarize_fit(fit: FieldFit) -> dict[str, Any]:
    """Return the numbers of a fit.

    They are in µm per axis unless they are lengths. Rows are counted from 0, as in the spots.
    """
    inlier_m = np.hypot(*fit.residual_m[~fit.outlier].T)
    sigma_um = 1e6 * region_sigma_m(fit)
    return {
        "spots": len(fit.spots),
        "outlier_rows": np.flatnonzero(fit.outlier).tolist(),
        "residual_rms_um": 1e6 * fit.rms_m if len(inlier_m) else None,
        "residual_max_um": 1e6 * float(inlier_m.max()) if len(inlier_m) else None,
        "noise_um": 1e6 * fit.noise_m,
        "surface_um": 1e6 * fit.surface_m,
        "sigma_um": sigma_um.tolist(),
        "sigma_rms_um": 1e6 * sigma_rms_m(fit),
        "sigma_max_um": 1e6 * float(fit.field.sigma_m(*fit.prior.display_extent.build_grid(SAMPLES_PER_SIDE)).max()),
    }


def region_sigma_m(fit: FieldFit) -> FloatArray:
    """Return sigma, rms over each region of the display, m.

    [REGIONS_PER_SIDE, REGIONS_PER_SIDE], the top row first.
    """
    sigma_m = fit.field.sigma_m(*fit.prior.display_extent.build_grid(SAMPLES_PER_SIDE)).reshape(
        REGIONS_PER_SIDE, SAMPLES_PER_SIDE // REGIONS_PER_SIDE, REGIONS_PER_SIDE, -1
    )
    rms_m: FloatArray = np.sqrt((sigma_m**2).mean(axis=(1, 3)))[::-1]
    return rms_m


def sigma_rms_m(fit: FieldFit) -> float:
    """Return sigma per axis, rms over the whole display, m."""
    return float(np.sqrt((region_sigma_m(fit) ** 2).mean()))


def draw_residuals(fit: FieldFit) -> str:
    """Draw the residuals as arrows at their spots, outliers as crosses. Return SVG."""
    x, y = _to_picture(fit, fit.spots.x_code, fit.spots.y_code)
    is_inlier = ~fit.outlier
    longest_m = max(1e-9, float(np.hypot(*fit.residual_m[is_inlier].T).max())) if is_inlier.any() else 1.0
    dx, dy = (fit.residual_m * (ARROW_FRACTION_MAX * PICTURE_SIDE / longest_m)).T
    arrows = [
        f"<line x1='{a:.1f}' y1='{b:.1f}' x2='{a + da:.1f}' y2='{b - db:.1f}' class='residual'/>"
        f"<circle cx='{a:.1f}' cy='{b:.1f}' r='1.5' class='bar'/>"
        for a, b, da, db, true in zip(x, y, dx, dy, is_inlier, strict=True)
        if true
    ]
    crosses = [
        f"<text x='{a:.1f}' y='{b + 4:.1f}' text-anchor='middle' style='fill: var(--nominal)'>×"
        f"<title>row {row}</title></text>"
        for row, (a, b, true) in enumerate(zip(x, y, is_inlier, strict=True))
        if not true
    ]
    caption = f"longest arrow {1e6 * longest_m:.1f} µm; × outlier"
    return _wrap_svg("Residuals", "".join([*arrows, *crosses, _draw_caption(caption)]))


def draw_sigma_map(fit: FieldFit) -> str:
    """Draw one sigma over the field, dark where it is large, with each cell's number as title. Return SVG."""
    grid_um = 1e6 * fit.field.sigma_grid_m[::-1]
    size = (PICTURE_SIDE - 2 * PICTURE_MARGIN) / len(grid_um)
    low, high = float(grid_um.min()), float(grid_um.max())
    cells = [
        f"<rect x='{PICTURE_MARGIN + column * size:.1f}' y='{PICTURE_MARGIN + row * size:.1f}' "
        f"width='{size:.1f}' height='{size:.1f}' "
        f"fill='hsl(210,70%,{92 - 62 * (value - low) / max(high - low, 1e-9):.0f}%)'>"
        f"<title>{value:.1f} µm</title></rect>"
        for row, line in enumerate(grid_um.tolist())
        for column, value in enumerate(line)
    ]
    return _wrap_svg(
        "Sigma over the field", "".join([*cells, _draw_caption(f"{low:.1f} (light) to {high:.1f} µm (dark)")])
    )


def _draw_caption(text: str) -> str:
    return f"<text x='{PICTURE_MARGIN}' y='{PICTURE_SIDE - 4}'>{text}</text>"


def _to_picture(fit: FieldFit, x_code: FloatArray, y_code: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions in the figure for codes, y upwards."""
    half_side = 0.5 * PICTURE_SIDE - PICTURE_MARGIN
    x_share, y_share = fit.field.extent.normalise(x_code, y_code)
    return 0.5 * PICTURE_SIDE + half_side * x_share, 0.5 * PICTURE_SIDE - half_side * y_share


def _wrap_svg(label: str, content: str) -> str:
    return f"<svg viewBox='0 0 {PICTURE_SIDE} {PICTURE_SIDE}' role='img' aria-label='{label}'>{content}</svg>"
