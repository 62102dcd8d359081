"""A term: a membrane that hangs loose rises less at first."""

from math import sqrt

from optodrive.core.kernels import kernel
from optodrive.physics.hypothesis import TermParameter
from optodrive.physics.term import Kernels, Term


@kernel
def membrane_slack_displacement(v, y, s, c, x):
    """Return the height of a membrane that is taut beyond v[0], m. x: height without the term, m."""
    return x * abs(x) / (sqrt(x * x + v[0] * v[0]) + v[0])


class MembraneSlack(Term):
    """√(z² + d²) − d with z the height of a taut membrane and d the depth of the slack, m."""

    key = "membrane_slack"
    label = "the membrane hangs loose"
    parameters = (TermParameter("depth", "m", 5e-6, 1e-7, 5e-5, "0.1 to 50 µm", starts=(2e-6, 2e-5)),)
    kernels = Kernels(displacement=membrane_slack_displacement)
    signature = "heights of weak pulses"
