"""Errors, by whose fault they are: the caller's input, the plan, the board, the link."""

from collections.abc import Mapping
from difflib import get_close_matches


class OptodriveError(Exception):
    """Base of all errors this package raises on purpose; `code` is stable and machine-readable."""

    code = "error"
    exit_status = 1
    problem: Mapping[str, object] | None = None
    """The problem document, where a daemon answered with one."""


class InputError(OptodriveError):
    """The caller's input is wrong: says where, which value, and what was expected, in one line."""

    code = "bad_input"
    exit_status = 2

    def __init__(self, where: str, value: object, expected: str, code: str = "bad_input") -> None:
        self.where = where
        self.value = value
        self.expected = expected
        self.code = code
        super().__init__(f"{where}: got {abbreviate(value)}, expected {expected}")


class RefusedError(OptodriveError):
    """The input is well formed, but what it asks for is refused (limits, deadlines, reach)."""

    code = "refused"
    feasibility: Mapping[str, object] | None = None
    """What was found of a sequence that does not fit, as `Admission.answer` gives it."""


class OverBudgetError(RefusedError):
    """A pulse that a cap does not allow. cap: the limiter's word for it; margin_j: energy too much.

    earliest_s: how much later the whole would fit; infinite where it never does.
    """

    code = "over_budget"

    def __init__(self, message: str, pixel: int, cap: str, margin_j: float, earliest_s: float) -> None:
        self.pixel = pixel
        self.cap = cap
        self.margin_j = margin_j
        self.earliest_s = earliest_s
        super().__init__(message)


class NotReadyError(OptodriveError):
    """The board is not in a state in which this may be done (not armed, busy, faulted)."""

    code = "not_ready"


class LinkError(OptodriveError):
    """The link to the board failed or was lost; the message carries the likely cause."""

    code = "link"


class BoardFaultError(OptodriveError):
    """The board is in FAULT; the message carries the fault's name and likely cause."""

    code = "board_fault"


class ProtocolError(OptodriveError):
    """Bytes or messages that the protocol does not allow."""

    code = "protocol"


class LocalProtocolError(ProtocolError):
    """This side tried to send what the protocol does not allow now: a bug here."""


class RemoteProtocolError(ProtocolError):
    """The other side sent what the protocol does not allow."""


def abbreviate(value: object, limit: int = 60) -> str:
    """`repr` of a value, cut to `limit` characters, so that one line stays one line."""
    text = repr(value)
    return text if len(text) <= limit else text[: limit - 1] + "…"


def suggest_nearest(name: str, known: list[str]) -> str:
    """A phrase that names the known word nearest to `name`, or all of them when none is near."""
    match = get_close_matches(name, known, n=1, cutoff=0.5)
    return f"nearest is '{match[0]}'" if match else "one of " + ", ".join(known)
