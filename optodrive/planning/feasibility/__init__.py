"""Whether a sequence fits on one beam, who breaks it, and the nearest that fits; best effort on request."""

from optodrive.planning.feasibility.check import admit
from optodrive.planning.feasibility.report import Admission, Fit, LeftOut, Nearest, Thinned
from optodrive.planning.feasibility.sequence_edits import scaled, stretched, without

__all__ = ["Admission", "Fit", "LeftOut", "Nearest", "Thinned", "admit", "scaled", "stretched", "without"]
