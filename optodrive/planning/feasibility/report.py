"""What is answered to whoever asks for a sequence: whether it fits, what breaks it, and what would fit."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

FitMode = Literal["as_is", "even", "priority"]
Proof = Literal["planned", "searched", "bound", "not found"]


@dataclass(frozen=True)
class Omission:
    """Pixels of a frame that are not shown, or a train, which is left out whole. source: as in the sequence."""

    name: str
    source: int
    pixels: tuple[int, ...]


@dataclass(frozen=True)
class SequenceReduction:
    """A set that fits with pixels left out; kept of asked: pixels of the frame that breaks it (1 for a train)."""

    kept: int
    requested: int
    omitted: tuple[Omission, ...]


@dataclass(frozen=True)
class NearestFeasible:
    """The nearest sets that fit, each planned; None where none was found.

    height: largest factor on all targets and powers, in hundredths; rate: least factor on all times, within 1 %
    complete: the bound on work cut none of these short
    """

    pixels: SequenceReduction | None
    height_factor: float | None
    time_factor: float | None
    complete: bool


@dataclass(frozen=True)
class FeasibilityReport:
    """Whether a sequence fits as asked, and what was made of it.

    proof: "planned" its plan fits, as the planner orders it; "searched" all orders were tried, or one was found that
    fits and is played; "bound" no order can fit; "not found" none was found, which proves nothing
    reason: "deadline", the name of a cap, or "unreachable"; name, pixel: of the first violation
    beam_needed_s, beam_there_s: of that frame, from when it may be shown to its last pulse's end as planned and to its
    deadline; of a train's pulse, from its nominal time; of the whole where it fits; None for what is out of reach
    beam_least_s: what the frame takes in any order at the least, None where that is not known
    plans, plans_max: how many were tried after the first, and the most that would have been
    height, left_out: what was done to it to make it fit
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
        """All of it, JSON-able."""
        return asdict(self)
