"""Comparison of the paper's facts with the parameter sets: rows, terminal table, JSON."""

from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from typing import Any, Literal

from optodrive.cli.output import print_json
from optodrive.lab.validation.outcomes import (
    DERIVED_FROM_FITTED,
    EXTENDED_DERIVED_FROM_FITTED,
    EXTENDED_FITTED_ON,
    FITTED_ON,
    INPUTS,
    NOT_MODELLED,
    OUTCOMES,
    REMARKS,
    simulate_outcomes,
)
from optodrive.physics.paper_facts import PaperFact, load_paper_facts
from optodrive.physics.parameters import load_parameters

NOTABLE_ERROR = 0.15
"""Relative error of the calibrated set above which a remark is shown."""

DISPLAY_UNITS = {"m": (1e6, "µm"), "N": (1e3, "mN"), "J": (1e3, "mJ"), "J/K": (1e6, "µJ/K"), "m K/W": (1e3, "mm K/W")}
"""Display scale and unit by SI unit."""


Role = Literal["input", "fitted", "predicted"]
HEADINGS = ("fact", "measured", "literal", "ratio", "calibrated", "ratio", "role", "extended", "ratio", "role")
USER_HEADINGS = ("model", "ratio")
MIN_TABLE_WIDTH, USER_WIDTH = 130, 18
"""Narrower terminals wrap lines instead of truncating digits, in characters."""


@dataclass(frozen=True)
class ValidationRow:
    """One fact and its value in each model, SI. `model` is the user's parameter set, None without one.

    Ratios are model over measured, None for a bound. `role` and `extended_role`: the calibrated or extended set was
    fitted on the fact, predicts it, or takes it as input. `remark` comments on an error of the calibrated set above
    NOTABLE_ERROR, '' otherwise.
    """

    fact: PaperFact
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


def build_validation_rows(user_file: Path | None = None) -> list[ValidationRow]:
    """Build a row for every fact that the parameter sets predict, in the order of the facts.

    `user_file` is a further parameter set to compare. Raises InputError for a file that cannot be used.
    """
    literal, calibrated = load_parameters("paper_s1_literal"), load_parameters("calibrated")
    extended_outcomes = simulate_outcomes(load_parameters("extended"))
    user_parameters = None if user_file is None else load_parameters(user_file)
    user_outcomes = {} if user_parameters is None else simulate_outcomes(user_parameters)
    models = INPUTS | OUTCOMES
    rows = []
    for name, fact in load_paper_facts().items():
        if name in models:
            literal_value, calibrated_value = models[name](literal), models[name](calibrated)
            remark = REMARKS[name] if fact.is_contradicted(calibrated_value, NOTABLE_ERROR) else ""
            extended = extended_outcomes.get(name, calibrated_value)
            value = None if user_parameters is None else user_outcomes.get(name, models[name](user_parameters))
            rows.append(
                ValidationRow(
                    fact=fact,
                    literal=literal_value,
                    literal_ratio=fact.ratio(literal_value),
                    calibrated=calibrated_value,
                    calibrated_ratio=fact.ratio(calibrated_value),
                    role=_find_role(name, {*FITTED_ON.values()} | DERIVED_FROM_FITTED),
                    extended=extended,
                    extended_ratio=fact.ratio(extended),
                    extended_role=_find_role(name, {*EXTENDED_FITTED_ON.values()} | EXTENDED_DERIVED_FROM_FITTED),
                    remark=remark,
                    model=value,
                    model_ratio=None if value is None else fact.ratio(value),
                )
            )
    return rows


def _find_role(name: str, fitted_facts: set[str]) -> Role:
    if name in INPUTS:
        return "input"
    return "fitted" if name in fitted_facts else "predicted"


def print_validation(json: bool = False, model: Path | None = None) -> None:
    """Print the table, or one JSON object. `model` is a further parameter set to compare."""
    rows = build_validation_rows(model)
    if json:
        print_json(build_document(rows))
    else:
        _print_table(rows)


def build_document(rows: list[ValidationRow]) -> dict[str, Any]:
    """Return the rows as JSON data in SI units. Numbers that are not finite become null."""
    facts = [asdict(row.fact) | _to_plain(row) for row in rows]
    fitted = {"fitted_on": dict(FITTED_ON), "extended_fitted_on": dict(EXTENDED_FITTED_ON)}
    return {"facts": facts, "not_modelled": dict(NOT_MODELLED)} | fitted


def _to_plain(row: ValidationRow) -> dict[str, Any]:
    plain = {key: value for key, value in vars(row).items() if key != "fact"}
    return {key: None if isinstance(value, float) and not isfinite(value) else value for key, value in plain.items()}


def format_cells(row: ValidationRow) -> list[str]:
    """Format a row as cells under HEADINGS, in display units."""
    scale, unit = DISPLAY_UNITS.get(row.fact.unit, (1.0, row.fact.unit))
    measured = ("< " if row.fact.relation == "<" else "") + f"{row.fact.value * scale:.4g}"
    if row.fact.uncertainty is not None:
        measured += f" ± {row.fact.uncertainty * scale:.2g}"
    return [
        row.fact.id,
        measured + ("" if unit == "1" else f" {unit}"),
        f"{row.literal * scale:.3g}",
        _format_ratio(row.literal_ratio),
        f"{row.calibrated * scale:.3g}",
        _format_ratio(row.calibrated_ratio),
        row.role,
        f"{row.extended * scale:.3g}",
        _format_ratio(row.extended_ratio),
        row.extended_role,
        *([] if row.model is None else [f"{row.model * scale:.3g}", _format_ratio(row.model_ratio)]),
    ]


def _format_ratio(ratio: float | None) -> str:
    return "" if ratio is None else f"{ratio:.2f}"


def _print_table(rows: list[ValidationRow]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title="Facts of the paper and their values in the parameter sets")
    has_user_model = rows[0].model is not None
    for heading in HEADINGS + (USER_HEADINGS if has_user_model else ()):
        table.add_column(heading, justify="left" if heading in ("fact", "role") else "right", no_wrap=True)
    for row in rows:
        table.add_row(*format_cells(row), style="bold" if row.remark else None)
    console = Console(width=max(Console().width, MIN_TABLE_WIDTH + (USER_WIDTH if has_user_model else 0)))
    console.print(table)
    console.print(f"Errors of the calibrated set above {100 * NOTABLE_ERROR:.0f} %:")
    for row in rows:
        if row.remark:
            console.print(f"  {row.fact.id}: {row.remark}", highlight=False, soft_wrap=True)
    console.print(
        f"No parameter set predicts the other {len(NOT_MODELLED)} facts; docs/reference/paper-facts.md says why."
    )
