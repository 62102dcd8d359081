"""One line of the doctor's: what was looked at, how it is, what was seen, what to do."""

from typing import Literal, NamedTuple

Grade = Literal["ok", "warning", "problem"]


class Finding(NamedTuple):
    """remedy: what to do, '' where nothing is to be done."""

    check: str
    grade: Grade
    seen: str
    remedy: str = ""


def ok(check: str, seen: str) -> Finding:
    """All is well."""
    return Finding(check, "ok", seen)


def warning(check: str, seen: str, remedy: str) -> Finding:
    """It works, but may not always."""
    return Finding(check, "warning", seen, remedy)


def problem(check: str, seen: str, remedy: str) -> Finding:
    """It will not work."""
    return Finding(check, "problem", seen, remedy)
