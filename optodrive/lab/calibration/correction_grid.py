"""grid.cor: a field as the 65 × 65 corrections that makers of galvo boards use; the variant LMC1COR_1.0.

As public readers of it agree: 22 bytes, the name in UTF-16 little-endian; 2 bytes; 63 doubles, the 44th of them codes
per millimetre; then 65 × 65 pairs of doubles, dx and dy in codes. Here rows go by y and columns by x, both rising,
every 1024 codes from 0, and a beam meant for a place is sent to codes = place × scale + 32768, plus what lies between
the nodes' dx and dy. Whether the software of a given board counts rows so was not tried.
"""

import struct
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
FILE_BYTES = HEADER.size + 16 * NODES_PER_SIDE * NODES_PER_SIDE
RESIDUAL_MAX_CODES = 1.0
"""A grid that the field's model does not follow to within this is none of mirrors and a lens."""


def write_correction_grid(path: Path, field: CalibratedField) -> None:
    """Write a field's corrections, whole or not at all."""
    scale = 1e-3 / _m_per_code(field.rad_per_code, field.focal_length_m)
    header_values = [0.0] * 63
    header_values[SCALE_INDEX] = scale
    with atomic_write(path) as temporary:
        temporary.write_bytes(
            HEADER.pack(FORMAT_LABEL, *header_values) + compute_corrections(field).astype("<f8").tobytes()
        )


def compute_corrections(field: CalibratedField) -> FloatArray:
    """Dx and dy in codes at every node, [65, 65, 2], rows by y."""
    x_code, y_code = _node_codes()
    code_m = _m_per_code(field.rad_per_code, field.focal_length_m)
    x_to, y_to = field.codes((x_code - CENTRE_CODE) * code_m, (y_code - CENTRE_CODE) * code_m, extrapolate=True)
    return np.stack([x_to - x_code, y_to - y_code], axis=-1)


def read_correction_grid(path: Path) -> tuple[float, FloatArray]:
    """Codes per millimetre, and dx and dy [65, 65, 2]; InputError for another kind of file."""
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
        raise InputError(f"{path}: corrections", "one that is no number", "numbers")
    return scale, np.array(corrections, dtype=np.float64)


def fit_correction_grid(path: Path, prior: FieldPrior) -> CalibratedField:
    """The field nearest to a grid's corrections; InputError where none comes near.

    A grid does not say how sure it is: sigma is only how far the field is from it.
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
        found = f"corrections that no mirrors and lens come nearer to than {residual_max_m / code_m:.1f} codes"
        raise InputError(str(path), found, f"{RESIDUAL_MAX_CODES:g} code")
    field, sigma_m = fit.field, np.full_like(fit.field.sigma_grid_m, residual_max_m)
    return CalibratedField(
        field.geometry, field.surface_m, field.extent, field.rad_per_code, field.focal_length_m, np.array(sigma_m)
    )


def _node_codes() -> tuple[FloatArray, FloatArray]:
    positions = NODE_SPACING_CODES * np.arange(NODES_PER_SIDE, dtype=np.float64)
    x_code, y_code = np.meshgrid(positions, positions)
    return x_code, y_code


def _m_per_code(rad_per_code: float, focal_length_m: float) -> float:
    """How far a code leads nominally, m."""
    return 2.0 * focal_length_m * rad_per_code
