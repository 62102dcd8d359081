"""Correction grids (grid.cor) of 65 × 65 nodes as galvo boards use them, variant LMC1COR_1.0.

The format according to public readers: 22 bytes with the name in UTF-16 little-endian; 2 bytes; 63 doubles, the 44th of
them codes per millimetre; then 65 × 65 pairs of doubles, dx and dy in codes. Here rows go by y and columns by x, both
increasing, every 1024 codes from 0. A beam for a position is sent to codes = position × scale + 32768, plus dx and dy
interpolated between the nodes. The row order has not been verified with the software of a given board.
"""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np

from optodrive.core.errors import InputError
from optodrive.core.files import atomic_write
from optodrive.core.types.arrays import FloatArray
from optodrive.device.calibrated_field import CalibratedField
from optodrive.device.field_geometry import CENTRE_CODE
from optodrive.lab.calibration.field_fit import fit_field
from optodrive.lab.calibration.field_prior import FieldPrior
from optodrive.lab.calibration.spots import MeasuredSpots

FORMAT_LABEL = "LMC1COR_1.0".encode("utf-16-le")
NODES_PER_SIDE = 65
NODE_SPACING_CODES = 1024
HEADER = struct.Struct("<22s2x63d")
SCALE_INDEX = 43
"""Index of the scale, codes per millimetre, among the doubles of the header."""
FILE_BYTES = HEADER.size + 16 * NODES_PER_SIDE * NODES_PER_SIDE
RESIDUAL_MAX_CODES = 1.0
"""Largest residual of the field model, codes; a grid beyond it does not describe mirrors and a lens."""


def write_correction_grid(path: Path, field: CalibratedField) -> None:
    """Write a field's corrections atomically."""
    scale = 1e-3 / _m_per_code(field.rad_per_code, field.focal_length_m)
    header_values = [0.0] * 63
    header_values[SCALE_INDEX] = scale
    with atomic_write(path) as temporary:
        temporary.write_bytes(
            HEADER.pack(FORMAT_LABEL, *header_values) + compute_corrections(field).astype("<f8").tobytes()
        )


def compute_corrections(field: CalibratedField) -> FloatArray:
    """Compute dx and dy in codes at every node, [65, 65, 2], rows by y."""
    x_code, y_code = _node_codes()
    code_m = _m_per_code(field.rad_per_code, field.focal_length_m)
    x_to, y_to = field.codes((x_code - CENTRE_CODE) * code_m, (y_code - CENTRE_CODE) * code_m, extrapolate=True)
    return np.stack([x_to - x_code, y_to - y_code], axis=-1)


def read_correction_grid(path: Path) -> tuple[float, FloatArray]:
    """Read codes per millimetre, and dx and dy [65, 65, 2]. Raise InputError for another kind of file."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from None
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
