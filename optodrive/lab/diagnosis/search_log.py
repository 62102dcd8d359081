"""Log of a search for causes: its progress, and the hypotheses that could not be computed."""

from collections.abc import Callable
from dataclasses import dataclass, field

from optodrive.core.errors import DivergedError

ProgressCallback = Callable[[str], None]


def ignore_progress(stage: str) -> None:
    """Report no progress."""


@dataclass(frozen=True)
class SearchLog:
    """Log of a search.

    failures: why a hypothesis could not be computed, by its label
    """

    on_progress: ProgressCallback = ignore_progress
    failures: dict[str, str] = field(default_factory=dict)

    def add_failure(self, label: str, error: DivergedError) -> None:
        """Note that a hypothesis could not be computed. Its first error is kept."""
        self.failures.setdefault(label, str(error))
