"""Feasibility of a sequence on one beam: report, nearest feasible variants and best-effort plans."""
