"""The paper's facts against the parameter sets: rows, a table on the terminal, JSON."""

from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from typing import Any, Literal

from optodrive.lab.validation.extended_outcomes import outcomes
from optodrive.lab.validation.paper_outcomes import (
    EXTENDED_FITTED_ON,
    EXTENDED_STANDS_ON_FITTED,
    FITTED_ON,
    INPUTS,
    OUTCOMES,
    REMARKS,
    SILENT,
    STANDS_ON_FITTED,
)
from optodrive.physics.paper_facts import Fact, paper_facts
from optodrive.physics.parameters import load_parameters

MISS = 0.15
"""Misses of the calibrated set beyond this share get a word."""

SCALES = {"m": (1e6, "µm"), "N": (1e3, "mN"), "J": (1e3, "mJ"), "J/K": (1e6, "µJ/K"), "m K/W": (1e3, "mm K/W")}
"""Display scale and unit of SI units whose numbers would be awkward."""


Role = Literal["input", "fitted", "predicted"]
HEADINGS = ("fact", "measured", "literal", "ratio", "calibrated", "ratio", "role", "extended", "ratio", "role")
OWN_HEADINGS = ("model", "ratio")
TABLE_WIDTH, OWN_WIDTH = 130, 18
"""Narrower terminals wrap lines rather than lose digits."""


@dataclass(frozen=True)
class Row:
    """One fact beside the models, SI; ratios are model over measured, None for a bound; model: the user's own, if any.

    role, extended_role: whether that set was fitted on it, predicts it, or took it from the paper; remark: what there
    is to say of the calibrated set, '' unless it misses.
    """

    fact: Fact
    literal: float
    literal_ratio: float | None
    calibrated: float
    calibrated_ratio: float | None
    role: Role
    extended: float
    extended_ratio: float | None
    extended_role: Role
    remark: str
    model: float | None = None
    model_ratio: float | None = None


def validate_table(own: Path | None = None) -> list[Row]:
    """Every fact that a parameter set can speak to, in the order of the facts. own: a parameter file to hold beside."""
    literal, calibrated = load_parameters("paper_s1_literal"), load_parameters("calibrated")
    simulated = outcomes(load_parameters("extended"))
    mine = None if own is None else load_parameters(own)
    told = {} if mine is None else outcomes(mine)
    models = INPUTS | OUTCOMES
    rows = []
    for name, fact in paper_facts().items():
        if name in models:
            said, fitted = models[name](literal), models[name](calibrated)
            remark = REMARKS[name] if fact.missed(fitted, MISS) else ""
            extended = simulated.get(name, fitted)
            value = None if mine is None else told.get(name, models[name](mine))
            rows.append(
                Row(
                    fact=fact,
                    literal=said,
                    literal_ratio=fact.ratio(said),
                    calibrated=fitted,
                    calibrated_ratio=fact.ratio(fitted),
                    role=_role(name, {*FITTED_ON.values()} | STANDS_ON_FITTED),
                    extended=extended,
                    extended_ratio=fact.ratio(extended),
                    extended_role=_role(name, {*EXTENDED_FITTED_ON.values()} | EXTENDED_STANDS_ON_FITTED),
                    remark=remark,
                    model=value,
                    model_ratio=None if value is None else fact.ratio(value),
                )
            )
    return rows


def _role(name: str, shown: set[str]) -> Role:
    if name in INPUTS:
        return "input"
    return "fitted" if name in shown else "predicted"


def validate(json: bool = False, model: Path | None = None) -> None:
    """Print the table, or one JSON object. model: a parameter file to hold beside the shipped sets."""
    rows = validate_table(model)
    if json:
        from optodrive.cli.options import print_json

        print_json(as_json(rows))
    else:
        _print_table(rows)


def as_json(rows: list[Row]) -> dict[str, Any]:
    """The rows as plain data in SI units; a number that is not finite becomes null."""
    facts = [asdict(row.fact) | _plain(row) for row in rows]
    fitted = {"fitted_on": dict(FITTED_ON), "extended_fitted_on": dict(EXTENDED_FITTED_ON)}
    return {"facts": facts, "silent": dict(SILENT)} | fitted


def _plain(row: Row) -> dict[str, Any]:
    plain = {key: value for key, value in vars(row).items() if key != "fact"}
    return {key: None if isinstance(value, float) and not isfinite(value) else value for key, value in plain.items()}


def cells(row: Row) -> list[str]:
    """A row as text under HEADINGS, in readable units."""
    scale, unit = SCALES.get(row.fact.unit, (1.0, row.fact.unit))
    measured = ("< " if row.fact.relation == "<" else "") + f"{row.fact.value * scale:.4g}"
    if row.fact.uncertainty is not None:
        measured += f" ± {row.fact.uncertainty * scale:.2g}"
    return [
        row.fact.id,
        measured + ("" if unit == "1" else f" {unit}"),
        f"{row.literal * scale:.3g}",
        _ratio(row.literal_ratio),
        f"{row.calibrated * scale:.3g}",
        _ratio(row.calibrated_ratio),
        row.role,
        f"{row.extended * scale:.3g}",
        _ratio(row.extended_ratio),
        row.extended_role,
        *([] if row.model is None else [f"{row.model * scale:.3g}", _ratio(row.model_ratio)]),
    ]


def _ratio(ratio: float | None) -> str:
    return "" if ratio is None else f"{ratio:.2f}"


def _print_table(rows: list[Row]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title="The paper's facts, and what the parameter sets make of them")
    own = rows[0].model is not None
    for heading in HEADINGS + (OWN_HEADINGS if own else ()):
        table.add_column(heading, justify="left" if heading in ("fact", "role") else "right", no_wrap=True)
    for row in rows:
        table.add_row(*cells(row), style="bold" if row.remark else None)
    console = Console(width=max(Console().width, TABLE_WIDTH + (OWN_WIDTH if own else 0)))
    console.print(table)
    console.print(f"Calibrated, off by more than {100 * MISS:.0f} %:")
    for row in rows:
        if row.remark:
            console.print(f"  {row.fact.id}: {row.remark}", highlight=False, soft_wrap=True)
    console.print(f"No parameter set speaks to the other {len(SILENT)} facts; docs/validation.md says why.")
