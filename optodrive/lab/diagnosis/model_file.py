"""Extended model as a parameter file that planner and daemon load unchanged."""

from collections.abc import Mapping, Sequence

from optodrive.physics.discovered_term import KEY, DiscoveredTerm
from optodrive.physics.term import TermValues
from optodrive.physics.terms import discover_terms

BASE_PARAMETER_SET = "surroundings"
VALUE_UNITS = {"tau_g": "s", "kappa": "m/K", "phi": "N/K"}


def build_model_toml(
    base: Mapping[str, float],
    terms: Mapping[str, TermValues],
    verdict: str,
    recording: str,
    width_m: float,
    estimator: str = "",
    discovered: Sequence[DiscoveredTerm] = (),
) -> str:
    """Return TOML of format optodrive-parameters, version 1.

    base, terms, verdict: as of `Discrepancy`; width_m: bridge width of the recorded pixel; estimator: how values were
    combined, where they are not of a single fit; discovered: functions that heights are planned with too
    """
    source = f'source = "fitted on {_sanitize(recording)}"'
    claim = "; ".join(part for part in (f"Fitted on {_sanitize(recording)}", estimator, f"verdict: {verdict}") if part)
    planned = ", ".join(f'"{key}"' for key in (*terms, *((KEY,) if discovered else ())))
    lines = [
        'format = "optodrive-parameters"',
        "version = 1",
        'name = "diagnosed"',
        f'base = "{BASE_PARAMETER_SET}"',
        f"planner_terms = [{planned}]",
        f'claims = "{claim}. For other bridge widths: R by 1 / width."',
        "",
    ]
    rows = [(name, base[name], unit) for name, unit in VALUE_UNITS.items()]
    rows += [("R_width_product", base["R"] * width_m, "m K/W"), ("C_mean", base["C"], "J/K")]
    lines += [line for row in rows for line in (*_format_quantity(*row), source, "")]
    lines += ["[[bridge]]", f"width_m = {width_m!r}"]
    for name, unit in (("R", "K/W"), ("C", "J/K")):
        lines += [*_format_quantity(f"bridge.{name}", base[name], unit), source]
    for key, values in terms.items():
        for item in discover_terms()[key].parameters:
            quantity = _format_quantity(f"terms.{key}.{item.name}", float(values[item.name]), item.unit)
            lines += ["", *quantity, source]
    for term in discovered:
        lines += ["", "[[discovered]]", source]
        lines += [f'{name} = "{getattr(term, name)}"' for name in ("where", "depends_on", "unit", "formula")]
        lines += [f"{name} = {getattr(term, name)!r}" for name in ("low", "high")]
        if term.memory_time_s is not None:
            lines.append(f"memory_time_s = {term.memory_time_s!r}")
        lines.append(f"values = [{', '.join(f'{value:.9g}' for value in term.values)}]")
    return "\n".join(lines) + "\n"


def _format_quantity(table: str, value: float, unit: str) -> list[str]:
    return [f"[{table}]", f"value = {value!r}", f'unit = "{unit}"']


def _sanitize(text: str) -> str:
    return "".join(letter for letter in text if letter.isprintable() and letter not in '"\\')
