"""Findings of `optodrive doctor`."""

from typing import Literal, NamedTuple

FindingStatus = Literal["ok", "warning", "problem"]


class Finding(NamedTuple):
    """One check: its name, status, observation, and the remedy ('' where none is needed)."""

    check: str
    status: FindingStatus
    observation: str
    remedy: str = ""


def report_ok(check: str, observation: str) -> Finding:
    """Return a finding without a problem."""
    return Finding(check, "ok", observation)


def report_warning(check: str, observation: str, remedy: str) -> Finding:
    """Return a finding of a condition that can cause a failure."""
    return Finding(check, "warning", observation, remedy)


def report_problem(check: str, observation: str, remedy: str) -> Finding:
    """Return a finding of a condition that prevents operation."""
    return Finding(check, "problem", observation, remedy)
