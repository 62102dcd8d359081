"""Result of a discovery in a pixel."""

from dataclasses import dataclass

from optodrive.core.types.discrepancy import InstrumentDisturbance
from optodrive.lab.discovery import Curve
from optodrive.lab.inference.claim import Claim, TermClaim

NODES = {
    "light": "the light that reaches the absorber",
    "absorber": "the heat flow into the absorber",
    "wall": "the heat flow into a part behind the absorber",
    "gas": "the heat flow into the gas",
    "membrane": "the membrane",
    "sensor": "the instrument",
}


UNITS = {"dabsorber/dt": "K/s", "dgas/dt": "K/s", "temperature": "K", "displacement": "m", "force": "N", "light": "1"}
"""Units of the equations and signals that a term is added to."""


@dataclass(frozen=True, eq=False)
class PixelFinding:
    """A term that the nominal pixel lacks.

    node: key of `NODES`; term: what is claimed of it; curve: None where the light changes at random
    """

    node: str
    term: TermClaim
    curve: Curve | None

    @property
    def kind(self) -> str:
        """Class of the formula, or "memory" for any function of the part behind the absorber."""
        form = self.term.chosen
        return "memory" if form.depends_on[:1] == ("memory",) else form.kind


@dataclass(frozen=True, eq=False)
class PixelDiscovery:
    """Terms found in a recording, none where there is no evidence.

    disturbances: of the instruments, subtracted before all else; claim: of all terms; judged_by: what no fit has seen,
    empty if nothing was sought; error_before, error_after: root mean square errors of the nominal and the extended
    pixel there, in units of the noise; parameters: of the extended pixel, SI; max_power_w: largest incident power of
    the recording
    """

    findings: tuple[PixelFinding, ...]
    disturbances: tuple[InstrumentDisturbance, ...]
    claim: Claim
    judged_by: str
    error_before: float
    error_after: float
    parameters: dict[str, float]
    elapsed_s: float
    max_power_w: float = 0.0
