"""Numbers of the paper, as shipped in configs/paper_facts.csv, one row per fact.

Further columns state what the validation makes of a fact (`optodrive.lab.validation`).
"""

import csv
from dataclasses import dataclass
from functools import cache
from typing import Literal, cast

from optodrive.device.config_file import locate_shipped

AMBIENT_C = 20.0
"""Ambient temperature of the paper's single-pixel runs: 527 °C at a rise of 507 K."""


@dataclass(frozen=True)
class PaperFact:
    """One number of the paper, SI but for temperatures, which are in °C.

    relation: '=' for a value, '<' for an upper bound; uncertainty: None if the paper gives none
    """

    id: str
    quantity: str
    relation: Literal["=", "<"]
    value: float
    unit: str
    uncertainty: float | None
    conditions: str
    where: str

    def ratio(self, model: float) -> float | None:
        """Return model over measured value, for temperatures by their rises, or None for a bound."""
        if self.relation == "<":
            return None
        zero = AMBIENT_C if self.unit == "°C" else 0.0
        return (model - zero) / (self.value - zero)

    def is_contradicted(self, model: float, tolerance: float) -> bool:
        """Return whether a model deviates by more than tolerance, relative to the fact, or exceeds a bound."""
        ratio = self.ratio(model)
        return model > self.value if ratio is None else abs(ratio - 1.0) > tolerance


@cache
def read_shipped_table(name: str) -> tuple[dict[str, str], ...]:
    """Return the rows of a shipped CSV file as text by column."""
    with locate_shipped(name).open(encoding="utf-8", newline="") as file:
        return tuple(csv.DictReader(file))


@cache
def load_paper_facts() -> dict[str, PaperFact]:
    """Return every fact by its id, in the order of the file."""
    return {row["id"]: _parse_fact(row) for row in read_shipped_table("paper_facts.csv")}


def list_stated(column: str) -> dict[str, str]:
    """Return the entries of a further column by fact."""
    return {row["id"]: row[column] for row in read_shipped_table("paper_facts.csv") if row[column]}


def _parse_fact(row: dict[str, str]) -> PaperFact:
    return PaperFact(
        id=row["id"],
        quantity=row["quantity"],
        relation=cast(Literal["=", "<"], row["relation"]),
        value=float(row["value"]),
        unit=row["unit"],
        uncertainty=float(row["uncertainty"]) if row["uncertainty"] else None,
        conditions=row["conditions"],
        where=row["where"],
    )
