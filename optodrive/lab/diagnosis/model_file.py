"""Extended model as a parameter file that planner and daemon load unchanged."""

from optodrive.core.types.discrepancy import Discrepancy
from optodrive.physics.terms import discover_terms

BASE_PARAMETER_SET = "surroundings"
VALUE_UNITS = {"tau_g": "s", "kappa": "m/K", "phi": "N/K"}


def build_model_toml(discrepancy: Discrepancy, recording: str, width_m: float, estimator: str = "") -> str:
    """Return TOML of format optodrive-parameters, version 1.

    width_m: bridge width of the recorded pixel; estimator: how values were combined, where they are not of a single fit
    """
    base, source = discrepancy.base, f'source = "fitted on {_sanitize(recording)}"'
    claim = "; ".join(
        part for part in (f"Fitted on {_sanitize(recording)}", estimator, f"verdict: {discrepancy.verdict}") if part
    )
    planned = ", ".join(f'"{key}"' for key in discrepancy.terms)
    lines = [
        'format = "optodrive-parameters"',
        "version = 1",
        'name = "diagnosed"',
        f'base = "{BASE_PARAMETER_SET}"',
        f"planner_terms = [{planned}]",
        f'claims = "{claim}. For other bridge widths: R by 1 / width."',
        "",
    ]
    for name, unit in VALUE_UNITS.items():
        lines += [f"[{name}]", f"value = {base[name]!r}", f'unit = "{unit}"', source, ""]
    lines += ["[R_width_product]", f"value = {base['R'] * width_m!r}", 'unit = "m K/W"', source, ""]
    lines += ["[C_mean]", f"value = {base['C']!r}", 'unit = "J/K"', source, ""]
    lines += ["[[bridge]]", f"width_m = {width_m!r}"]
    for name, unit in (("R", "K/W"), ("C", "J/K")):
        lines += [f"[bridge.{name}]", f"value = {base[name]!r}", f'unit = "{unit}"', source]
    for key, values in discrepancy.terms.items():
        for item in discover_terms()[key].parameters:
            lines += [
                "",
                f"[terms.{key}.{item.name}]",
                f"value = {float(values[item.name])!r}",
                f'unit = "{item.unit}"',
                source,
            ]
    return "\n".join(lines) + "\n"


def _sanitize(text: str) -> str:
    return "".join(letter for letter in text if letter.isprintable() and letter not in '"\\')
