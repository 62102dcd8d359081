"""Library of formulas: functions of one variable with at most two numbers inside, by which a term may be written."""

from dataclasses import dataclass
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
MAX_EXPONENT = 50.0


@kernel
def evaluate_form(form: int, z: float, first: float, second: float) -> float:
    """Return the value of a form at z. first, second: its inner numbers, see `FORMS`."""
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


KIND_OF_POWER = {0: "constant", 1: "linear", 2: "quadratic", 3: "cubic", 4: "quartic", 5: "quintic"}


def list_forms(z: FloatArray) -> list[Form]:
    """Return the library for a variable that takes values around the nodes z [n], increasing."""
    size, span = float(np.abs(z).max()), float(z[-1] - z[0])

    def starts(first: FloatArray, second: float = 0.0) -> FloatArray:
        return np.column_stack([first, np.full(len(first), second)])

    forms = [
        Form(POWER, starts(np.array([float(power)])), 0, KIND_OF_POWER[power], "" if power == 0 else f"{{z}}^{power}")
        for power in range(6)
    ]
    inner = z[1:-1]
    widths = span * np.geomspace(0.05, 4.0, 14)
    if z[0] < 0.0 < z[-1]:
        forms += [
            Form(ABSOLUTE, starts(np.zeros(1)), 0, "absolute value", "|{z}|"),
            Form(SIGNED_POWER, starts(np.array([2.0])), 0, "quadratic friction", "{z} |{z}|"),
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
    forms += [
        Form(EXPONENTIAL, starts(np.concatenate([widths, -widths])), 1, "exponential", "(exp({z} / {a}) - 1)"),
        Form(ABOVE, starts(inner), 1, "end stop", "max({z} - {a}, 0)"),
        Form(BELOW, starts(inner), 1, "end stop", "max({a} - {z}, 0)"),
        Form(STEP, starts(inner, 0.01 * span), 1, "step", "step({z} - {a})"),
        Form(SINE, starts(np.array([1.0, *(np.arange(1, 9) * pi / span)])), 1, "sine", "sin({a} {z})"),
        Form(COSINE, starts(np.array([1.0, *(np.arange(1, 9) * pi / span)])), 1, "sine", "(cos({a} {z}) - 1)"),
        Form(
            BUMP,
            np.array([(centre, width * span) for centre in inner for width in (0.03, 0.08, 0.2)]),
            2,
            "bump",
            "exp(-(({z} - {a}) / {b})^2)",
        ),
    ]
    return forms
