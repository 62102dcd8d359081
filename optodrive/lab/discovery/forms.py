"""Library of formulas: functions of one variable with at most two numbers inside, by which a term may be written."""

from dataclasses import dataclass, replace
from math import cos, exp, pi, sin, sqrt, tanh

import numpy as np

from optodrive.core.kernels import kernel
from optodrive.core.types.arrays import FloatArray

(
    POWER,
    ABSOLUTE,
    SIGNED_POWER,
    SATURATION,
    EXPONENTIAL,
    DEAD_ZONE,
    ABOVE,
    BELOW,
    STEP,
    SINE,
    COSINE,
    BUMP,
    CLIP,
    DECAY,
) = range(14)
CURVES = (SINE, COSINE, BUMP)
THRESHOLDS = (DEAD_ZONE, ABOVE, BELOW, STEP, CLIP)
"""Forms whose first inner number is a value of the variable."""
MAX_EXPONENT = 50.0
CONSTANT, CURVE, CHANGE = "constant", "curve", "change with time"
"""Kinds that are no names: what follows the data without a formula of physics, and what no state explains."""
NAMELESS = {CURVE: "a curve without a formula", CHANGE: "changes with time: not explained"}
MAX_SHARE_OF_FRICTION = 0.1
"""Scale of a tanh, relative to the variable's largest value, below which it is dry friction."""
SMOOTHING = {SATURATION: 2e-3, EXPONENTIAL: 1e-2, BUMP: 1e-2, DECAY: 1e-4}
"""Smallest inner number that is a scale, relative to the variable's largest value."""


@kernel
def evaluate_form(form: int, z: float, first: float, second: float) -> float:
    """Return the value of a form at z. first, second: its inner numbers, see `list_forms`."""
    if form == POWER:
        value = 1.0
        for _ in range(int(first)):
            value *= z
        return value
    if form == ABSOLUTE:
        return abs(z)
    if form == SIGNED_POWER:
        root = sqrt(abs(z)) if first == 0.5 else abs(z) ** first
        return root if z >= 0.0 else -root
    if form == SATURATION:
        return float(tanh(z / first))
    if form == EXPONENTIAL:
        return float(exp(min(z / first, MAX_EXPONENT)) - 1.0)
    if form == DEAD_ZONE:
        excess = max(abs(z) - first, 0.0)
        return excess if z >= 0.0 else -excess
    if form == ABOVE:
        return max(z - first, 0.0)
    if form == BELOW:
        return max(first - z, 0.0)
    if form == STEP:
        return float(0.5 + 0.5 * tanh((z - first) / second))
    if form == SINE:
        return float(sin(first * z))
    if form == COSINE:
        return float(cos(first * z) - 1.0)
    if form == CLIP:
        return min(z, first)
    if form == DECAY:
        return float(exp(-z / first))
    return float(exp(-(((z - first) / second) ** 2)))


@dataclass(frozen=True)
class Form:
    """One form with starts for its inner numbers.

    free: how many inner numbers are fitted; kind: class of formula; text: formula with {z}, {a}, {b}
    """

    code: int
    starts: FloatArray  # [starts, 2]
    free: int
    kind: str
    text: str

    def evaluate(self, z: FloatArray, first: float, second: float) -> FloatArray:
        """Return the values [n] at z [n]."""
        return np.array([evaluate_form(self.code, float(each), first, second) for each in z])

    def apply(self, numbers: FloatArray, z: FloatArray) -> FloatArray:
        """Return the values [n] of a term at z [n]. numbers: amplitude and inner numbers."""
        return np.asarray(numbers[0] * self.evaluate(z, numbers[1], numbers[2]))

    def limit(self, nodes: FloatArray, first: float) -> tuple[float, float]:
        """Return limits of the first inner number from the variable's nodes."""
        size, span = float(np.abs(nodes).max()), float(nodes[-1] - nodes[0])
        edge = SMOOTHING.get(self.code, 0.0) * size
        if self.code == SATURATION:
            return edge, 5.0 * size
        if self.code == EXPONENTIAL:
            return (edge, np.inf) if first > 0.0 else (-np.inf, -edge)
        if self.code in (SINE, COSINE):
            return 0.3 * first, 3.0 * first
        if self.code == DECAY:
            return edge, 10.0 * size
        return float(nodes[0]) - 0.5 * span, float(nodes[-1]) + 0.5 * span

    def settle(self, first: float, size: float) -> "Form":
        """Return the form with the name that its fitted inner number gives it. size: the variable's largest value."""
        if self.code != SATURATION:
            return self
        if first < MAX_SHARE_OF_FRICTION * size:
            return replace(self, kind="dry friction", text="sign({z})")
        return replace(self, kind="saturation", text="tanh({z} / {a})")

    def describe(self, values: FloatArray, variable: str, factor: str = "") -> str:
        """Return one term as a formula, such as -7.41e+05 x^3. values: amplitude and inner numbers."""
        amplitude, first, second = (f"{value:.4g}" for value in values[:3])
        text = self.text.format(z=variable, a=first, b=second)
        return " ".join(part for part in (amplitude, factor, text) if part)


LINEAR = Form(POWER, np.array([[1.0, 0.0]]), 0, "linear", "{z}")
"""Form of a term with memory."""


def list_forms(z: FloatArray) -> list[Form]:
    """Return the library for a variable that takes values around the nodes z [n], increasing."""
    size, span = float(np.abs(z).max()), float(z[-1] - z[0])

    def starts(first: FloatArray, second: float = 0.0) -> FloatArray:
        return np.column_stack([first, np.full(len(first), second)])

    powers = {CONSTANT: "", "linear": "{z}", "quadratic": "{z}^2", "cubic": "{z}^3", "fourth power": "{z}^4"}
    forms = [
        Form(POWER, starts(np.array([float(power)])), 0, kind, text)
        for power, (kind, text) in enumerate(powers.items())
    ]
    inner = z[1:-1]
    widths = span * np.geomspace(0.05, 4.0, 14)
    if z[0] < 0.0 < z[-1]:
        forms += [
            Form(ABSOLUTE, starts(np.zeros(1)), 0, "absolute value", "|{z}|"),
            Form(SIGNED_POWER, starts(np.array([2.0])), 0, "quadratic drag", "{z} |{z}|"),
            Form(SIGNED_POWER, starts(np.array([0.5])), 0, "square root", "sign({z}) sqrt|{z}|"),
            Form(SATURATION, starts(size * np.array([0.01])), 1, "dry friction", "sign({z})"),
            Form(SATURATION, starts(size * np.geomspace(0.1, 1.0, 6)), 1, "saturation", "tanh({z} / {a})"),
            Form(DEAD_ZONE, starts(np.unique(np.abs(inner))), 1, "dead zone", "sign({z}) max(|{z}| - {a}, 0)"),
        ]
    else:
        forms.append(Form(SIGNED_POWER, starts(np.array([0.5])), 0, "square root", "sqrt({z})"))
    if z[0] >= 0.0:
        forms += [
            Form(CLIP, starts(inner), 1, "saturation", "min({z}, {a})"),
            Form(DECAY, starts(np.concatenate([inner[inner < 0.5 * span], widths])), 1, "decay", "exp(-{z} / {a})"),
        ]
    bumps = np.array([(centre, width * span) for centre in inner for width in (0.03, 0.08, 0.2)])
    waves = starts(np.array([1.0, *(np.arange(1, 9) * pi / span)]))
    return [
        *forms,
        Form(EXPONENTIAL, starts(np.concatenate([widths, -widths])), 1, "exponential", "(exp({z} / {a}) - 1)"),
        Form(ABOVE, starts(inner), 1, "end stop", "max({z} - {a}, 0)"),
        Form(BELOW, starts(inner), 1, "end stop", "max({a} - {z}, 0)"),
        Form(STEP, starts(inner, 0.01 * span), 1, "threshold", "step({z} - {a})"),
        Form(SINE, waves, 1, CURVE, "sin({a} {z})"),
        Form(COSINE, waves, 1, CURVE, "(cos({a} {z}) - 1)"),
        Form(BUMP, bumps, 2, CURVE, "exp(-(({z} - {a}) / {b})^2)"),
    ]
