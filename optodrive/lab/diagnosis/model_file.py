"""The extended model as a parameter file that planner and daemon load as it is."""

from optodrive.core.types.discrepancy import Discrepancy
from optodrive.physics.terms import known_terms

BASE = "surroundings"
UNITS = {"tau_g": "s", "kappa": "m/K", "phi": "N/K"}


def model_toml(found: Discrepancy, recording: str, width_m: float, what: str = "") -> str:
    """TOML of format optodrive-parameters, version 1.

    width_m: of the bridge the recording was made with; what: the numbers are, where they are not of one fit
    """
    base, source = found.base, f'source = "fitted on {_plain(recording)}"'
    claim = "; ".join(part for part in (f"Fitted on {_plain(recording)}", what, f"verdict: {found.verdict}") if part)
    planned = ", ".join(f'"{key}"' for key in found.terms)
    lines = [
        'format = "optodrive-parameters"',
        "version = 1",
        'name = "diagnosed"',
        f'base = "{BASE}"',
        f"planner_terms = [{planned}]",
        f'claims = "{claim}. For other bridge widths: R by 1 / width."',
        "",
    ]
    for name, unit in UNITS.items():
        lines += [f"[{name}]", f"value = {base[name]!r}", f'unit = "{unit}"', source, ""]
    lines += ["[R_width_product]", f"value = {base['R'] * width_m!r}", 'unit = "m K/W"', source, ""]
    lines += ["[C_mean]", f"value = {base['C']!r}", 'unit = "J/K"', source, ""]
    lines += ["[[bridge]]", f"width_m = {width_m!r}"]
    for name, unit in (("R", "K/W"), ("C", "J/K")):
        lines += [f"[bridge.{name}]", f"value = {base[name]!r}", f'unit = "{unit}"', source]
    for key, values in found.terms.items():
        for item in known_terms()[key].parameters:
            lines += [
                "",
                f"[terms.{key}.{item.name}]",
                f"value = {float(values[item.name])!r}",
                f'unit = "{item.unit}"',
                source,
            ]
    return "\n".join(lines) + "\n"


def _plain(text: str) -> str:
    return "".join(letter for letter in text if letter.isprintable() and letter not in '"\\')
