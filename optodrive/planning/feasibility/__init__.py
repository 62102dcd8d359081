"""Feasibility of a sequence on one beam, with its report, the nearest feasible variants and best-effort plans."""
