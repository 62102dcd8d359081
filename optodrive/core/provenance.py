"""Provenance of a result: program, command, date, configuration and recordings."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from hashlib import sha256
from shlex import join
from typing import Any

from optodrive import __version__


@dataclass(frozen=True)
class Provenance:
    """Origin of a result.

    version: of optodrive; created_at: ISO 8601, UTC; command: as typed in a shell; configuration: its name, None
    without one; configuration_sha256: of its canonical JSON; recordings: names of the files or folders
    """

    version: str
    created_at: str
    command: str
    configuration: str | None
    configuration_sha256: str | None
    recordings: tuple[str, ...]

    @classmethod
    def capture(
        cls, arguments: Sequence[str], recordings: Sequence[str], configuration: tuple[str, str] | None = None
    ) -> "Provenance":
        """Return the provenance of a result that this command computes now.

        configuration: name and canonical JSON
        """
        name, text = (None, None) if configuration is None else configuration
        return cls(
            __version__,
            datetime.now(UTC).isoformat(timespec="seconds"),
            join(["optodrive", *arguments]),
            name,
            None if text is None else sha256(text.encode()).hexdigest(),
            tuple(recordings),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the provenance as JSON values."""
        return asdict(self) | {"recordings": list(self.recordings)}

    def to_rows(self) -> list[tuple[str, str]]:
        """Return label and text of each entry."""
        configuration = (
            "none: priors from the recording, or broad"
            if self.configuration is None
            else f"{self.configuration}, SHA-256 {self.configuration_sha256}"
        )
        return [
            ("recordings", ", ".join(self.recordings)),
            ("command", self.command),
            ("date", self.created_at),
            ("configuration", configuration),
            ("optodrive", self.version),
        ]
