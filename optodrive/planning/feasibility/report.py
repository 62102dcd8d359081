"""Feasibility report with the first violation and the nearest feasible variants."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

from optodrive.core.types.push_options import FitMode

Proof = Literal["planned", "searched", "bound", "not found"]
"""Evidence for a report's verdict; see FeasibilityReport."""


@dataclass(frozen=True)
class Omission:
    """Omitted pixels of a frame, or an omitted train.

    source: index as in the sequence
    name: id of the frame, or the train
    pixels: that are left out
    """

    name: str
    source: int
    pixels: tuple[int, ...]


@dataclass(frozen=True)
class SequenceReduction:
    """A feasible variant with pixels omitted.

    kept, requested: pixels of the frame of the violation (1 for a train); omitted: pixels and trains left out.
    """

    kept: int
    requested: int
    omitted: tuple[Omission, ...]


@dataclass(frozen=True)
class NearestFeasible:
    """The nearest feasible variants, each confirmed by a plan, and None for a kind without one.

    pixels: variant with pixels omitted
    height_factor: largest factor on all targets and powers, in hundredths
    time_factor: smallest factor on all times, within 1 %
    complete: no search reached its limit of plans
    """

    pixels: SequenceReduction | None
    height_factor: float | None
    time_factor: float | None
    complete: bool


@dataclass(frozen=True)
class FeasibilityReport:
    """Whether a sequence fits as requested, and the variant that was planned.

    proof: "planned": the planner's order fits; "searched": all orders were tried, or another order fits and is planned;
    "bound": a lower bound excludes every order; "not found": the search ended without a proof
    message: the verdict in one line
    reason: "deadline", the name of a cap, "unreachable", or "nothing_raised"; name, pixel: frame or train and pixel of
    the first violation
    beam_required_s, beam_available_s: for a frame, from its earliest start to the planned end of its last pulse and to
    its deadline; for a train's pulse, from its requested start; for a feasible sequence, of the whole; None if
    unreachable
    beam_lower_bound_s: lower bound of the frame's beam time over all orders, None if unknown
    nearest: nearest feasible variants, None for a feasible sequence
    plans_tried, plans_tried_max: plans after the first, and their limit
    fit, height_factor, omitted: fit mode, and the changes that it made to the sequence
    fits: whether the whole sequence fits as requested
    """

    fits: bool
    proof: Proof
    message: str
    reason: str | None = None
    name: str | None = None
    pixel: int | None = None
    beam_required_s: float | None = None
    beam_available_s: float | None = None
    beam_lower_bound_s: float | None = None
    nearest: NearestFeasible | None = None
    plans_tried: int = 0
    plans_tried_max: int = 0
    fit: FitMode = "as_is"
    height_factor: float = 1.0
    omitted: tuple[Omission, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the report as a JSON-serialisable dictionary."""
        return asdict(self)
