"""Output of a fitted field: field.toml, the figures of a report, and the correction grid of a board.

Correction grids (grid.cor) have 65 × 65 nodes, variant LMC1COR_1.0, as galvo boards use them. The format according to
public readers: 22 bytes with the name in UTF-16 little-endian; 2 bytes; 63 doubles, the 44th of them codes per
millimetre; then 65 × 65 pairs of doubles, dx and dy in codes. Here rows go by y and columns by x, both increasing,
every 1024 codes from 0. A beam for a position is sent to codes = position × scale + 32768, plus dx and dy interpolated
between the nodes. The row order has not been verified with the software of a given board.
"""

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from optodrive.core.errors import InputError, refuse_os_error
from optodrive.core.files import atomic_write, write_text
from optodrive.core.types.arrays import FloatArray
from optodrive.device.calibrated_field import CalibratedField, format_field, strip_toml_specials
from optodrive.device.field_geometry import CENTRE_CODE
from optodrive.lab.calibration.field_fit import FieldFit, fit_field
from optodrive.lab.calibration.spots import FieldPrior, MeasuredSpots

REGIONS_PER_SIDE = 3
SAMPLES_PER_SIDE = 9
"""Samples of sigma per side of the display: three per side of a region."""
PICTURE_SIDE, PICTURE_MARGIN = 420, 20
ARROW_FRACTION_MAX = 0.07
"""Length of the longest arrow, as a fraction of the figure's side."""
FORMAT_LABEL = "LMC1COR_1.0".encode("utf-16-le")
NODES_PER_SIDE = 65
NODE_SPACING_CODES = 1024
HEADER = struct.Struct("<22s2x63d")
SCALE_INDEX = 43
"""Index of the scale, codes per millimetre, among the doubles of the header."""
FILE_BYTES = HEADER.size + 16 * NODES_PER_SIDE * NODES_PER_SIDE
RESIDUAL_MAX_CODES = 1.0
"""Largest residual of the field model, codes; a grid beyond it does not describe mirrors and a lens."""


def write_field(path: Path, fit: FieldFit, source: str = "") -> None:
    """Write the field of a fit atomically.

    source: plain-text origin of the measurement
    """
    metadata: dict[str, str | float | int] = {
        "source": strip_toml_specials(source),
        "spots": len(fit.spots),
        "outliers": int(fit.outlier.sum()),
        "rms_um": round(1e6 * fit.rms_m, 3) if np.isfinite(fit.rms_m) else 0.0,
        "noise_um": round(1e6 * fit.noise_m, 3),
        "surface_um": round(1e6 * fit.surface_m, 3),
    }
    write_text(path, format_field(fit.field, metadata))


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
    return np.asarray(np.sqrt((sigma_m**2).mean(axis=(1, 3)))[::-1], dtype=np.float64)


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
        for a, b, da, db in np.column_stack([x, y, dx, dy])[is_inlier]
    ]
    crosses = [
        f"<text x='{x[row]:.1f}' y='{y[row] + 4:.1f}' text-anchor='middle' style='fill: var(--nominal)'>×"
        f"<title>row {row}</title></text>"
        for row in np.flatnonzero(fit.outlier)
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
    caption = _draw_caption(f"{low:.1f} (light) to {high:.1f} µm (dark)")
    return _wrap_svg("Sigma over the field", "".join([*cells, caption]))


def _draw_caption(text: str) -> str:
    return f"<text x='{PICTURE_MARGIN}' y='{PICTURE_SIDE - 4}'>{text}</text>"


def _to_picture(fit: FieldFit, x_code: FloatArray, y_code: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions in the figure for codes, y upwards."""
    half_side = 0.5 * PICTURE_SIDE - PICTURE_MARGIN
    x_share, y_share = fit.field.extent.normalise(x_code, y_code)
    return 0.5 * PICTURE_SIDE + half_side * x_share, 0.5 * PICTURE_SIDE - half_side * y_share


def _wrap_svg(label: str, content: str) -> str:
    return f"<svg viewBox='0 0 {PICTURE_SIDE} {PICTURE_SIDE}' role='img' aria-label='{label}'>{content}</svg>"


def write_correction_grid(path: Path, field: CalibratedField) -> None:
    """Write a field's corrections atomically."""
    scale = 1e-3 / _m_per_code(field.rad_per_code, field.focal_length_m)
    header_values = [0.0] * 63
    header_values[SCALE_INDEX] = scale
    with atomic_write(path) as temporary:
        header = HEADER.pack(FORMAT_LABEL, *header_values)
        temporary.write_bytes(header + compute_corrections(field).astype("<f8").tobytes())


def compute_corrections(field: CalibratedField) -> FloatArray:
    """Compute dx and dy in codes at every node, [65, 65, 2], rows by y."""
    x_code, y_code = _node_codes()
    code_m = _m_per_code(field.rad_per_code, field.focal_length_m)
    x_to, y_to = field.codes((x_code - CENTRE_CODE) * code_m, (y_code - CENTRE_CODE) * code_m, extrapolate=True)
    return np.stack([x_to - x_code, y_to - y_code], axis=-1)


def read_correction_grid(path: Path) -> tuple[float, FloatArray]:
    """Read codes per millimetre, and dx and dy [65, 65, 2]. Raise InputError for another kind of file."""
    with refuse_os_error(path, "a readable file"):
        content = path.read_bytes()
    if content[: len(FORMAT_LABEL)] != FORMAT_LABEL:
        raise InputError(f"{path}: first 22 bytes", content[:22], "LMC1COR_1.0 in UTF-16")
    if len(content) != FILE_BYTES:
        raise InputError(f"{path}: size", len(content), f"{FILE_BYTES} bytes")
    scale = float(HEADER.unpack_from(content)[1 + SCALE_INDEX])
    corrections = np.frombuffer(content, dtype="<f8", offset=HEADER.size).reshape(NODES_PER_SIDE, NODES_PER_SIDE, 2)
    if not np.isfinite(scale) or scale <= 0.0:
        raise InputError(f"{path}: codes per millimetre", scale, "more than 0")
    if not np.all(np.isfinite(corrections)):
        raise InputError(f"{path}: corrections", "a value that is not finite", "numbers")
    return scale, np.array(corrections, dtype=np.float64)


def fit_correction_grid(path: Path, prior: FieldPrior) -> CalibratedField:
    """Fit a field to a grid's corrections. Raise InputError if no field fits.

    A grid states no uncertainty: sigma is the largest deviation of the field from it.
    """
    scale, corrections = read_correction_grid(path)
    x_code, y_code = _node_codes()
    x_to, y_to = x_code + corrections[..., 0], y_code + corrections[..., 1]
    x_share, y_share = prior.extent.normalise(x_to, y_to)
    inside = (np.abs(x_share) <= 1.0) & (np.abs(y_share) <= 1.0)
    places_m = [1e-3 * (code - CENTRE_CODE)[inside] / scale for code in (x_code, y_code)]
    spots = MeasuredSpots(x_to[inside], y_to[inside], *places_m)
    code_m = _m_per_code(prior.rad_per_code, prior.focal_length_m)
    fit = fit_field(spots, prior, 0.1 * code_m)
    residual_max_m = np.abs(fit.residual_m).max() if len(spots) else np.inf
    if fit.outlier.any() or residual_max_m > RESIDUAL_MAX_CODES * code_m:
        found = f"corrections from which the best field deviates by {residual_max_m / code_m:.1f} codes"
        raise InputError(str(path), found, f"{RESIDUAL_MAX_CODES:g} code")
    field, sigma_m = fit.field, np.full_like(fit.field.sigma_grid_m, residual_max_m)
    return replace(field, sigma_grid_m=np.array(sigma_m))


def _node_codes() -> tuple[FloatArray, FloatArray]:
    positions = NODE_SPACING_CODES * np.arange(NODES_PER_SIDE, dtype=np.float64)
    x_code, y_code = np.meshgrid(positions, positions)
    return x_code, y_code


def _m_per_code(rad_per_code: float, focal_length_m: float) -> float:
    """Return the nominal displacement of the beam per code, m."""
    return 2.0 * focal_length_m * rad_per_code
