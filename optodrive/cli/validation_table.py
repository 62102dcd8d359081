"""Comparison of the paper's facts with the parameter sets: rows, terminal table, JSON."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from optodrive.cli.output import print_json
from optodrive.core.document import to_json
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
from optodrive.physics.parameters import ParameterSet, load_parameters

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
    user_parameters = None if user_file is None else load_parameters(user_file)
    literal, calibrated = (_predict(load_parameters(name)) for name in ("paper_s1_literal", "calibrated"))
    extended = _predict(load_parameters("extended"), is_simulated=True)
    own = None if user_parameters is None else _predict(user_parameters, is_simulated=True)
    rows = []
    for name, fact in load_paper_facts().items():
        if name in literal:
            values = literal[name], calibrated[name], extended[name], None if own is None else own[name]
            ratios = [None if value is None else fact.ratio(value) for value in values]
            remark = REMARKS[name] if fact.is_contradicted(calibrated[name], NOTABLE_ERROR) else ""
            role = _find_role(name, {*FITTED_ON.values()} | DERIVED_FROM_FITTED)
            extended_role = _find_role(name, {*EXTENDED_FITTED_ON.values()} | EXTENDED_DERIVED_FROM_FITTED)
            nominal = values[0], ratios[0], values[1], ratios[1], role
            rows.append(
                ValidationRow(fact, *nominal, values[2], ratios[2], extended_role, remark, values[3], ratios[3])
            )
    return rows


def _predict(parameters: ParameterSet, is_simulated: bool = False) -> dict[str, float]:
    """Return inputs and outcomes by fact, in closed form or simulated with the set's terms."""
    outcomes = {name: model(parameters) for name, model in (INPUTS | OUTCOMES).items()}
    return outcomes | (simulate_outcomes(parameters) if is_simulated else {})


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
    stated = [to_json(row) for row in rows]
    facts = [each.pop("fact") | each for each in stated]
    fitted = {"fitted_on": dict(FITTED_ON), "extended_fitted_on": dict(EXTENDED_FITTED_ON)}
    return {"facts": facts, "not_modelled": dict(NOT_MODELLED)} | fitted


def format_cells(row: ValidationRow) -> list[str]:
    """Format a row as cells under HEADINGS, in display units."""
    scale, unit = DISPLAY_UNITS.get(row.fact.unit, (1.0, row.fact.unit))
    measured = ("< " if row.fact.relation == "<" else "") + f"{row.fact.value * scale:.4g}"
    if row.fact.uncertainty is not None:
        measured += f" ± {row.fact.uncertainty * scale:.2g}"

    def format_pair(value: float, ratio: float | None) -> tuple[str, str]:
        return f"{value * scale:.3g}", "" if ratio is None else f"{ratio:.2f}"

    cells = [row.fact.id, measured + ("" if unit == "1" else f" {unit}")]
    cells += [*format_pair(row.literal, row.literal_ratio), *format_pair(row.calibrated, row.calibrated_ratio)]
    cells += [row.role, *format_pair(row.extended, row.extended_ratio), row.extended_role]
    return cells + ([] if row.model is None else [*format_pair(row.model, row.model_ratio)])


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
