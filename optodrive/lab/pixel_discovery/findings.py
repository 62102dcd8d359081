"""Result of a discovery in a pixel."""

from dataclasses import dataclass

from optodrive.core.types.discrepancy import InstrumentDisturbance
from optodrive.lab.discovery import Curve

NODES = {
    "light": "the light that reaches the absorber",
    "absorber": "the heat flow into the absorber",
    "wall": "the heat flow into a part behind the absorber",
    "gas": "the heat flow into the gas",
    "membrane": "the membrane",
    "sensor": "the instrument",
}


@dataclass(frozen=True, eq=False)
class PixelFinding:
    """A term that the nominal pixel lacks.

    node: key of `NODES`; where: equation or signal that it is added to, with its unit; depends_on, curve, formula,
    kind, gain and probability: as of `discovery.Finding`; curve is None where the light changes at random
    """

    node: str
    where: str
    unit: str
    depends_on: tuple[str, ...]
    kind: str
    formula: str
    curve: Curve | None
    gain: float
    probability: float


@dataclass(frozen=True, eq=False)
class PixelDiscovery:
    """Terms found in a recording, none where there is no evidence.

    disturbances: of the instruments, subtracted before all else; judged_by: what no fit has seen, empty if nothing was
    sought; error_before, error_after: root mean square errors of the nominal and the extended pixel there, in units of
    the noise; parameters: of the extended pixel, SI; epsilon: absorptance that they hold for
    """

    findings: tuple[PixelFinding, ...]
    disturbances: tuple[InstrumentDisturbance, ...]
    judged_by: str
    error_before: float
    error_after: float
    parameters: dict[str, float]
    epsilon: float
    elapsed_s: float
