"""Feasibility of a sequence on one beam: report, nearest feasible variants and best-effort plans."""

from optodrive.planning.feasibility.check import check_feasibility
from optodrive.planning.feasibility.report import (
    FeasibilityReport,
    FitMode,
    NearestFeasible,
    Omission,
    SequenceReduction,
)
from optodrive.planning.feasibility.sequence_edits import omit_pixels, scale_sequence, stretch_sequence

__all__ = [
    "FeasibilityReport",
    "FitMode",
    "NearestFeasible",
    "Omission",
    "SequenceReduction",
    "check_feasibility",
    "omit_pixels",
    "scale_sequence",
    "stretch_sequence",
]
