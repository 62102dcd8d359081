"""Log of a search for causes: its progress, and the hypotheses that could not be computed."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from numpy.linalg import LinAlgError

from optodrive.core.errors import DivergedError

T = TypeVar("T")
UNCOMPUTABLE = (DivergedError, LinAlgError, FloatingPointError, ZeroDivisionError)
"""Errors of a hypothesis that cannot be computed."""

ProgressCallback = Callable[[str], None]


def ignore_progress(stage: str) -> None:
    """Report no progress."""


@dataclass(frozen=True)
class SearchLog:
    """Log of a search.

    failures: why a hypothesis could not be computed, by its label; omissions: why a step was left out that the verdict
    does not need, by its name
    """

    on_progress: ProgressCallback = ignore_progress
    failures: dict[str, str] = field(default_factory=dict)
    omissions: dict[str, str] = field(default_factory=dict)

    def add_failure(self, label: str, error: Exception) -> None:
        """Note that a hypothesis could not be computed. Its first error is kept."""
        self.failures.setdefault(label, str(error))

    def attempt(self, step: str, function: Callable[..., T], default: T, *arguments: Any) -> T:
        """Return the result of a step that the verdict does not need, or the default and a note if it fails."""
        try:
            return function(*arguments)
        except Exception as error:
            self.omissions.setdefault(step, f"{type(error).__name__}: {error}".splitlines()[0])
            return default
