"""One line of the doctor's: what was looked at, how it is, what was seen, what to do."""

from typing import Literal, NamedTuple

FindingStatus = Literal["ok", "warning", "problem"]


class Finding(NamedTuple):
    """remedy: what to do, '' where nothing is to be done."""

    check: str
    status: FindingStatus
    observation: str
    remedy: str = ""


def report_ok(check: str, observation: str) -> Finding:
    """All is well."""
    return Finding(check, "ok", observation)


def report_warning(check: str, observation: str, remedy: str) -> Finding:
    """It works, but may not always."""
    return Finding(check, "warning", observation, remedy)


def report_problem(check: str, observation: str, remedy: str) -> Finding:
    """It will not work."""
    return Finding(check, "problem", observation, remedy)
