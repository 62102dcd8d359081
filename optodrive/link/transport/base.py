"""What a transport is: four verbs and a name. Whether a board or a simulation answers is not visible here."""

from typing import Protocol


class Transport(Protocol):
    """A byte stream to a board. All methods raise LinkError when the link fails."""

    name: str

    def open(self) -> None:
        """Open the link exclusively; raises InputError when what the configuration names is not there."""

    def read(self, timeout_s: float) -> bytes:
        """Bytes that have arrived; waits at most timeout_s for the first."""

    def write(self, data: bytes) -> None:
        """Hand all of data to the operating system."""

    def close(self) -> None:
        """Close the link, which may be opened again; does nothing when it is closed."""

    def release(self) -> None:
        """Close for good: whatever opening has started ends."""
