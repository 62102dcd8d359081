"""Calibrated scan field: display positions to converter codes and back, with their uncertainty.

Errors that the physical geometry does not explain are a smooth correction per axis: a sum of products of Legendre
polynomials of both axes, of total degree 2 to ORDER; the physical geometry covers the lower degrees. Outside the extent
it keeps its value at the edge.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field as Item

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.plausibility import PlausibleRange
from optodrive.core.toml_model import Section, check_format, parse_table, read_toml
from optodrive.core.types.arrays import FloatArray, ReadOnlyArrays
from optodrive.device.config_sections import DIRECT_WIRING, FocalLength, Wiring
from optodrive.device.field_geometry import CENTRE_CODE, CODE_MAX, GEOMETRY_RANGES, FieldGeometry, beam_position_m

ORDER = 6
DEGREES = [(i, total - i) for total in range(2, ORDER + 1) for i in range(total + 1)]
"""Degrees in x and y of each term."""
TERM_COUNT = len(DEGREES)
VARIANCE_RATIO = 0.5
"""Prior variance of each total degree over that of the degree below."""


@dataclass(frozen=True)
class Extent:
    """Range of codes for which a field is calibrated: x_code ± x_half and y_code ± y_half."""

    x_code: float
    y_code: float
    x_half: float
    y_half: float

    def normalise(self, x_code: FloatArray, y_code: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return codes of any shape in units of the half range from the centre, −1 to 1 inside."""
        return (x_code - self.x_code) / self.x_half, (y_code - self.y_code) / self.y_half

    def build_grid(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the codes of count × count points from edge to edge, [count²] each, with x as the fast index."""
        axis = np.linspace(-1.0, 1.0, count)
        v, u = np.meshgrid(axis, axis, indexing="ij")
        return self.x_code + self.x_half * u.ravel(), self.y_code + self.y_half * v.ravel()


def evaluate_terms(extent: Extent, x_code: FloatArray, y_code: FloatArray) -> FloatArray:
    """Return every term at codes [n], [n, TERM_COUNT], each with mean square 1 over the extent."""
    # Clipped: a polynomial of degree 6 runs away outside, where nothing was measured.
    u, v = (np.clip(axis, -1.0, 1.0) for axis in extent.normalise(x_code, y_code))
    along_x, along_y = _evaluate_legendre(u), _evaluate_legendre(v)
    out = np.empty((len(u), TERM_COUNT), order="F")
    for at, (i, j) in enumerate(DEGREES):
        np.multiply(along_x[i], along_y[j], out=out[:, at])
    return out


def compute_prior_widths() -> FloatArray:
    """Return the prior standard deviation of each coefficient, [TERM_COUNT], for a surface of rms 1 over the extent."""
    degree = np.array([i + j for i, j in DEGREES])
    # Shared by the degree + 1 terms of a degree: the ratio is that of whole degrees.
    variance = VARIANCE_RATIO ** (degree - 2.0) / (degree + 1.0)
    width: FloatArray = np.sqrt(variance / variance.sum())
    return width


def _evaluate_legendre(position: FloatArray) -> list[FloatArray]:
    """Return the Legendre polynomials of degree 0 to ORDER, each with mean square 1 on −1 to 1."""
    plain = [np.ones_like(position), position]
    for n in range(1, ORDER):
        plain.append(((2 * n + 1) * position * plain[n] - n * plain[n - 1]) / (n + 1))
    return [np.sqrt(2 * n + 1) * each for n, each in enumerate(plain)]


PointMap = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
BLOCK_POINTS = 8192
"""Points per block; the arrays of one block fit into the processor's cache."""
MAX_ITERATIONS = 8
"""Iterations of the search for codes."""
CODE_TOLERANCE = 1.0
"""Step, in codes, below which the search ends; the next step would be at most a hundredth of it."""
FOLDOVER_FACTOR = 10.0
"""Largest residual of a solution over the nominal length of its last step; a larger one means another branch."""
GUESS_ORDER = 7
GUESS_NODES = 40
"""Degree of the polynomial for the initial guess, and its sampling nodes per axis."""
OUTSIDE_WEIGHT = 0.01
"""Weight of points outside the extent in the fit of the initial guess; few look-ups are there."""
GUESS_MARGIN = 1.1
"""Range of the initial guess over the converter's range, and of its fully weighted part over the extent."""


@dataclass(frozen=True, eq=False)
class CalibratedField(ReadOnlyArrays):
    """Map from codes to display positions: physical geometry plus a smooth surface. Arrays are read-only.

    surface_m: [2, TERM_COUNT] coefficients of x and y; rad_per_code, focal_length_m, wiring: of the configuration that
    the field was calibrated with; sigma_grid_m: [k, k] standard uncertainty per axis over the extent, rows by y
    display: name of the display that it was calibrated on, "" if unknown
    """

    geometry: FieldGeometry
    surface_m: FloatArray
    extent: Extent
    rad_per_code: float
    focal_length_m: float
    sigma_grid_m: FloatArray
    display: str = ""
    wiring: Wiring = DIRECT_WIRING

    @cached_property
    def is_finite(self) -> bool:
        """Whether all codes have finite positions, which are not all one."""
        with np.errstate(all="ignore"):
            positions_m = np.array(self._block_position_m(*_build_nodes()))
            return bool(np.all(np.isfinite(positions_m * positions_m)) and np.all(np.ptp(positions_m, axis=1) > 0.0))

    def position_m(self, x_code: ArrayLike, y_code: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the beam's position on the display for codes, which may be fractional and of any shape, m."""
        return _apply_blockwise(self._block_position_m, x_code, y_code)

    def codes(self, x_m: ArrayLike, y_m: ArrayLike, extrapolate: bool = False) -> tuple[FloatArray, FloatArray]:
        """Return the unrounded codes that send the beam to display positions of any shape, m.

        The codes are NaN for a position outside the converter's range. extrapolate: return codes outside it as well.
        """
        x_code, y_code = _apply_blockwise(self._solve_codes, x_m, y_m)
        if extrapolate:
            return x_code, y_code
        outside = (np.minimum(x_code, y_code) < 0.0) | (np.maximum(x_code, y_code) > CODE_MAX)
        return np.where(outside, np.nan, x_code), np.where(outside, np.nan, y_code)

    def angles_rad(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the commanded mechanical mirror angles, rad, for display positions, m, or NaN as in `codes`."""
        x_code, y_code = self.codes(x_m, y_m)
        return (x_code - CENTRE_CODE) * self.rad_per_code, (y_code - CENTRE_CODE) * self.rad_per_code

    def sigma_m(self, x_code: ArrayLike, y_code: ArrayLike) -> FloatArray:
        """Return the standard uncertainty of the position per axis, m, for codes, or infinity outside the extent."""
        u = self.extent.normalise(np.asarray(x_code, dtype=np.float64), np.asarray(y_code, dtype=np.float64))
        last = len(self.sigma_grid_m) - 1
        inside = (np.abs(u[0]) <= 1.0) & (np.abs(u[1]) <= 1.0)
        x_at, y_at = (np.where(inside, axis + 1.0, 0.0) * 0.5 * last for axis in u)
        column, row = (np.minimum(at.astype(np.int64), last - 1) for at in (x_at, y_at))
        x_part, y_part = x_at - column, y_at - row
        grid = self.sigma_grid_m
        low = grid[row, column] * (1.0 - x_part) + grid[row, column + 1] * x_part
        high = grid[row + 1, column] * (1.0 - x_part) + grid[row + 1, column + 1] * x_part
        return np.asarray(np.where(inside, low * (1.0 - y_part) + high * y_part, np.inf), dtype=np.float64)

    def _block_position_m(self, x_code: FloatArray, y_code: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the positions for codes of one block, [n] each."""
        scale = self.rad_per_code
        x_m, y_m = beam_position_m(self.geometry, (x_code - CENTRE_CODE) * scale, (y_code - CENTRE_CODE) * scale)
        more = evaluate_terms(self.extent, x_code, y_code) @ self.surface_m.T
        return x_m + more[:, 0], y_m + more[:, 1]

    def _solve_codes(self, x_m: FloatArray, y_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solve for the codes of positions of one block, [n] each, by a quasi-Newton iteration.

        The polynomial guess serves as the inverse's slope: each step is the guess's difference over the residual.
        """
        # Its derivative is the field's to a thousandth, so one step from it suffices almost everywhere.
        guess = self._guess_codes(x_m, y_m)
        codes = guess
        for _ in range(MAX_ITERATIONS):
            at_x_m, at_y_m = self._block_position_m(codes[:, 0], codes[:, 1])
            step = guess - self._guess_codes(at_x_m, at_y_m)
            codes = codes + step
            if not np.any(np.abs(step) > CODE_TOLERANCE):
                break
        # Far outside, the guess folds over, and the iteration converges to another position.
        residual_m = np.hypot(at_x_m - x_m, at_y_m - y_m)
        max_residual_m = FOLDOVER_FACTOR * CODE_TOLERANCE * 2.0 * self.focal_length_m * self.rad_per_code
        failed = ~(np.all(np.abs(step) <= CODE_TOLERANCE, axis=1) & (residual_m <= max_residual_m))
        # Refused and not clipped: a code near the end of the range would send the beam to a wrong place.
        codes[failed] = np.nan
        return codes[:, 0], codes[:, 1]

    def _guess_codes(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Return the initial guess of the codes, [n, 2]."""
        scale_m, coefficients = self._guess_polynomial
        guess: FloatArray = _build_monomials(x_m / scale_m, y_m / scale_m) @ coefficients
        return guess

    @cached_property
    def _guess_polynomial(self) -> tuple[float, FloatArray]:
        """Scale, m, and coefficients [powers, 2] of the polynomial from positions to codes."""
        x_code, y_code = _build_nodes()
        x_m, y_m = self._block_position_m(x_code, y_code)
        scale_m = float(max(np.abs(x_m).max(), np.abs(y_m).max()))
        target = np.column_stack([x_code, y_code])
        outside = np.maximum(*np.abs(self.extent.normalise(x_code, y_code))) > GUESS_MARGIN
        weight = np.where(outside, OUTSIDE_WEIGHT, 1.0)[:, None]
        powers = _build_monomials(x_m / scale_m, y_m / scale_m)
        coefficients = np.asarray(np.linalg.lstsq(powers * weight, target * weight, rcond=None)[0], dtype=np.float64)
        return scale_m, coefficients


def _build_nodes() -> tuple[FloatArray, FloatArray]:
    """Return the codes at which the polynomial for the initial guess is fitted, [n] each."""
    # Chebyshev nodes: at equal distances the polynomial would oscillate towards the ends.
    node = np.cos(np.pi * (np.arange(GUESS_NODES) + 0.5) / GUESS_NODES) * GUESS_MARGIN * (CODE_MAX - CENTRE_CODE)
    x_code, y_code = (CENTRE_CODE + axis.ravel() for axis in np.meshgrid(node, node))
    return x_code, y_code


def _build_monomials(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the monomials of total degree up to GUESS_ORDER, [n, powers]."""
    # By columns, as they are filled and multiplied.
    out = np.empty((len(x), (GUESS_ORDER + 1) * (GUESS_ORDER + 2) // 2), order="F")
    out[:, 0] = 1.0
    at = 0
    for degree in range(1, GUESS_ORDER + 1):
        before, at = at, at + degree
        for index in range(degree):
            np.multiply(out[:, before + index], x, out=out[:, at + index])
        np.multiply(out[:, before + degree - 1], y, out=out[:, at + degree])
    return out


def _apply_blockwise(function: PointMap, first: ArrayLike, second: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Apply a function of two flat arrays block by block to two arrays of any shape."""
    one, two = np.broadcast_arrays(np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64))
    shape = one.shape
    one, two = one.ravel(), two.ravel()
    out = np.empty((2, len(one)))
    for start in range(0, len(one), BLOCK_POINTS):
        part = slice(start, start + BLOCK_POINTS)
        out[0, part], out[1, part] = function(one[part], two[part])
    return out[0].reshape(shape), out[1].reshape(shape)


FORMAT = "optodrive-field"
VERSION = 1


Code = Annotated[float, Item(ge=-1e5, le=1e5)]
HalfRange = Annotated[float, Item(ge=1, le=1e5)]
Coefficient = Annotated[float, Item(ge=-1e3, le=1e3)]
PIXEL_OFFSET = PlausibleRange(0.0, 5e-3, "m")
Displacement = Annotated[float, Item(ge=-1, le=1), PIXEL_OFFSET]


class _Scanner(Section):
    rad_per_code: Annotated[float, Item(gt=0), PlausibleRange(3e-8, 4e-4, "rad")]
    focal_length_m: FocalLength
    swap_axes: bool = False
    invert_x: bool = False
    invert_y: bool = False


class _Extent(Section):
    x_code: Code
    y_code: Code
    x_half: HalfRange
    y_half: HalfRange


class _Surface(Section):
    order: Literal[6]
    x_m: Annotated[tuple[Displacement, ...], Item(min_length=TERM_COUNT, max_length=TERM_COUNT)]
    y_m: Annotated[tuple[Displacement, ...], Item(min_length=TERM_COUNT, max_length=TERM_COUNT)]


class _Uncertainty(Section):
    sigma_m: Annotated[tuple[tuple[Annotated[float, Item(gt=0, le=1), PIXEL_OFFSET], ...], ...], Item(min_length=2)]


class _FieldFile(Section):
    format: str
    version: int
    about: dict[str, str | float | int] = Item(default_factory=dict)
    scanner: _Scanner
    extent: _Extent
    geometry: Annotated[dict[str, Coefficient], GEOMETRY_RANGES]
    surface: _Surface
    uncertainty: _Uncertainty


def strip_toml_specials(text: str) -> str:
    """Return the text without characters that a basic TOML string cannot hold."""
    return "".join(letter for letter in text if letter.isprintable() and letter not in '"\\')


def format_field(field: CalibratedField, about: dict[str, str | float | int]) -> str:
    """Return a field as TOML of format optodrive-field, version 1."""
    extent = field.extent
    if field.display:
        about = {"display": strip_toml_specials(field.display), **about}
    lines = [f'format = "{FORMAT}"', f"version = {VERSION}", "", "[about]"]
    lines += [f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value!r}" for key, value in about.items()]
    lines += ["", "[scanner] # of the configuration that it was calibrated with"]
    lines += [f"rad_per_code = {field.rad_per_code!r}", f"focal_length_m = {field.focal_length_m!r}"]
    lines += [f"{key} = {str(value).lower()}" for key, value in field.wiring._asdict().items()]
    lines += ["", "[extent] # codes for which it is calibrated"]
    lines += [f"{key} = {float(getattr(extent, key))!r}" for key in ("x_code", "y_code", "x_half", "y_half")]
    lines += ["", "[geometry]"]
    lines += [f"{key} = {value!r}" for key, value in field.geometry._asdict().items()]
    lines += ["", "[surface] # Legendre products of total degree 2 to order, each of mean square 1", f"order = {ORDER}"]
    lines += [f"{axis}_m = {row.tolist()!r}" for axis, row in zip("xy", field.surface_m, strict=True)]
    lines += ["", "[uncertainty] # standard uncertainty per axis over the extent, rows by y", "sigma_m = ["]
    lines += [f"  [{', '.join(f'{value:.4g}' for value in row)}]," for row in field.sigma_grid_m.tolist()]
    return "\n".join([*lines, "]"]) + "\n"


def load_field(path: Path) -> CalibratedField:
    """Load field.toml. Raise InputError for another format or version, and for invalid content."""
    table = read_toml(path)
    check_format(path, table, FORMAT, VERSION)
    content = parse_table(path, table, _FieldFile)
    differing = set(FieldGeometry._fields) ^ set(content.geometry)
    if differing:
        raise InputError(
            f"{path}: geometry", ", ".join(sorted(differing)), f"exactly {', '.join(FieldGeometry._fields)}"
        )
    grid = content.uncertainty.sigma_m
    if any(len(row) != len(grid) for row in grid):
        raise InputError(f"{path}: uncertainty.sigma_m", [len(row) for row in grid], "as many columns as rows")
    field = CalibratedField(
        geometry=FieldGeometry(**content.geometry),
        surface_m=np.array([content.surface.x_m, content.surface.y_m]),
        extent=Extent(**content.extent.model_dump()),
        rad_per_code=content.scanner.rad_per_code,
        focal_length_m=content.scanner.focal_length_m,
        sigma_grid_m=np.array(grid),
        display=str(content.about.get("display", "")),
        wiring=Wiring(*(getattr(content.scanner, key) for key in Wiring._fields)),
    )
    if not field.is_finite:
        raise InputError(
            f"{path}: geometry and surface",
            Unquoted("infinite or equal positions"),
            "one position on the display per code",
        )
    return field
