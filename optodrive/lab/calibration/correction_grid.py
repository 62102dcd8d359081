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
from optodrive.core.files import written_whole
from optodrive.core.types.arrays import FloatArray
from optodrive.device.calibrated_field import Field
from optodrive.device.field_geometry import CENTRE_CODE
from optodrive.lab.calibration.field_fit import fit_field
from optodrive.lab.calibration.field_prior import Prior
from optodrive.lab.calibration.spots import Spots

LABEL = "LMC1COR_1.0".encode("utf-16-le")
NODES = 65
CELL_CODES = 1024
HEAD = struct.Struct("<22s2x63d")
SCALE_AT = 43
WHOLE = HEAD.size + 16 * NODES * NODES
FITS_CODES = 1.0
"""A grid that the field's model does not follow to within this is none of mirrors and a lens."""


def write_grid(path: Path, field: Field) -> None:
    """Write a field's corrections, whole or not at all."""
    scale = 1e-3 / _code_m(field.rad_per_code, field.focal_length_m)
    head = [0.0] * 63
    head[SCALE_AT] = scale
    with written_whole(path) as temporary:
        temporary.write_bytes(HEAD.pack(LABEL, *head) + corrections(field).astype("<f8").tobytes())


def corrections(field: Field) -> FloatArray:
    """Dx and dy in codes at every node, [65, 65, 2], rows by y."""
    x_code, y_code = _nodes()
    code_m = _code_m(field.rad_per_code, field.focal_length_m)
    x_to, y_to = field.codes((x_code - CENTRE_CODE) * code_m, (y_code - CENTRE_CODE) * code_m, beyond=True)
    return np.stack([x_to - x_code, y_to - y_code], axis=-1)


def read_grid(path: Path) -> tuple[float, FloatArray]:
    """Codes per millimetre, and dx and dy [65, 65, 2]; InputError for another kind of file."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from None
    if content[: len(LABEL)] != LABEL:
        raise InputError(f"{path}: first 22 bytes", content[:22], "LMC1COR_1.0 in UTF-16")
    if len(content) != WHOLE:
        raise InputError(f"{path}: size", len(content), f"{WHOLE} bytes")
    scale = float(HEAD.unpack_from(content)[1 + SCALE_AT])
    moved = np.frombuffer(content, dtype="<f8", offset=HEAD.size).reshape(NODES, NODES, 2)
    if not np.isfinite(scale) or scale <= 0.0:
        raise InputError(f"{path}: codes per millimetre", scale, "more than 0")
    if not np.all(np.isfinite(moved)):
        raise InputError(f"{path}: corrections", "one that is no number", "numbers")
    return scale, np.array(moved, dtype=np.float64)


def field_of_grid(path: Path, prior: Prior) -> Field:
    """The field nearest to a grid's corrections; InputError where none comes near.

    A grid does not say how sure it is: sigma is only how far the field is from it.
    """
    scale, moved = read_grid(path)
    x_code, y_code = _nodes()
    x_to, y_to = x_code + moved[..., 0], y_code + moved[..., 1]
    x_share, y_share = prior.extent.shares(x_to, y_to)
    inside = (np.abs(x_share) <= 1.0) & (np.abs(y_share) <= 1.0)
    places_m = [1e-3 * (code - CENTRE_CODE)[inside] / scale for code in (x_code, y_code)]
    spots = Spots(x_to[inside], y_to[inside], *places_m)
    code_m = _code_m(prior.rad_per_code, prior.focal_length_m)
    fit = fit_field(spots, prior, 0.1 * code_m)
    left_m = np.abs(fit.residual_m).max() if len(spots) else np.inf
    if fit.outlier.any() or left_m > FITS_CODES * code_m:
        found = f"corrections that no mirrors and lens come nearer to than {left_m / code_m:.1f} codes"
        raise InputError(str(path), found, f"{FITS_CODES:g} code")
    field, sigma_m = fit.field, np.full_like(fit.field.sigma_grid_m, left_m)
    return Field(
        field.geometry, field.surface_m, field.extent, field.rad_per_code, field.focal_length_m, np.array(sigma_m)
    )


def _nodes() -> tuple[FloatArray, FloatArray]:
    at = CELL_CODES * np.arange(NODES, dtype=np.float64)
    x_code, y_code = np.meshgrid(at, at)
    return x_code, y_code


def _code_m(rad_per_code: float, focal_length_m: float) -> float:
    """How far a code leads nominally, m."""
    return 2.0 * focal_length_m * rad_per_code
