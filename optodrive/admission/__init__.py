"""Whether a sequence fits on one beam, who breaks it, and the nearest that fits; best effort on request."""

from optodrive.admission.admitting import admit
from optodrive.admission.answer import Admission, Fit, LeftOut, Nearest, Thinned
from optodrive.admission.changes import scaled, stretched, without

__all__ = ["Admission", "Fit", "LeftOut", "Nearest", "Thinned", "admit", "scaled", "stretched", "without"]
