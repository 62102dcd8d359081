"""Errors by origin: the caller's input, the plan, the board, the link."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches

MESSAGE_MAX = 1000
"""Longest message about invalid input, characters."""
UNQUOTED_MAX = 200
"""Longest description that stands in place of a value, characters."""


class OptodriveError(Exception):
    """Base of all errors that this package raises deliberately. `code` is stable and machine-readable."""

    code = "error"
    exit_status = 1
    problem: Mapping[str, object] | None = None
    """Problem document of the daemon's answer, if there is one."""

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle the message and the fields, so that a process of a pool can raise it in its parent."""
        return _restore_error, (type(self), self.args, self.__dict__)


def _restore_error(kind: type[OptodriveError], args: tuple[object, ...], fields: dict[str, object]) -> OptodriveError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(fields)
    return error


class InputError(OptodriveError):
    """Invalid input. The message states place, value, or that it is `MISSING`, and expectation in one line."""

    code = "bad_input"
    exit_status = 2

    def __init__(self, where: str, value: object, expected: str, code: str = "bad_input") -> None:
        self.where = where
        self.value = value
        self.expected = expected
        self.code = code
        shown = abbreviate(value)
        found = shown if shown == repr(MISSING) else f"got {shown}"
        message = escape_unprintable(f"{where}: {found}, expected {expected}")
        super().__init__(message if len(message) <= MESSAGE_MAX else message[: MESSAGE_MAX - 1] + "…")


@contextmanager
def refuse_os_error(place: object, expected: str) -> Iterator[None]:
    """Convert an OSError of the block into an InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(str(place), error.strerror or str(error), expected) from None


class DivergedError(InputError):
    """A model whose states leave their range, or whose signals are no numbers, at the given parameters."""

    code = "diverged"


class RefusedError(OptodriveError):
    """A well-formed request that is refused because of limits, deadlines or reach."""

    code = "refused"
    feasibility: Mapping[str, object] | None = None
    """Feasibility report of a sequence that does not fit, as JSON."""


class OverBudgetError(RefusedError):
    """A pulse that a cap does not allow.

    cap: the limiter's name of the cap; margin_j: excess energy of the pulse; fits_after_s: delay after which the whole
    request fits, infinite if it never does
    """

    code = "over_budget"

    def __init__(self, message: str, pixel: int, cap: str, margin_j: float, fits_after_s: float) -> None:
        self.pixel = pixel
        self.cap = cap
        self.margin_j = margin_j
        self.fits_after_s = fits_after_s
        super().__init__(message)


class NotReadyError(OptodriveError):
    """The board's state does not allow the operation (not armed, busy, faulted)."""

    code = "not_ready"


class StoppedError(NotReadyError):
    """The request came before a STOP or a disarm and was not executed before it."""

    code = "stopped"


class BusyError(NotReadyError):
    """Too many requests wait. The same request may succeed later."""

    code = "busy"


class LinkError(OptodriveError):
    """The link to the board failed. The message states the likely cause."""

    code = "link"


class BoardFaultError(OptodriveError):
    """The board is in FAULT. The message states the fault and its likely cause."""

    code = "board_fault"


class ProtocolError(OptodriveError):
    """Bytes or messages that violate the protocol."""

    code = "protocol"


class LocalProtocolError(ProtocolError):
    """This side was about to send a message that the protocol does not allow now, which is a bug."""


class RemoteProtocolError(ProtocolError):
    """The other side violated the protocol."""


def escape_unprintable(text: str) -> str:
    """Return a text in one line, with escapes for line ends and other control characters, as of a terminal."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def abbreviate(value: object, limit: int = 60) -> str:
    """Return `repr` of a value, cut to `limit` characters. A value may nest deeper than Python's stack."""
    if isinstance(value, Unquoted):
        limit = max(limit, UNQUOTED_MAX)
    try:
        text = repr(value)
    except RecursionError:
        return "deeper nesting"
    return text if len(text) <= limit else text[: limit - 1] + "…"


def suggest_nearest(name: str, known: list[str]) -> str:
    """Return a phrase with the known name nearest to `name`, or with all known names if none is near."""
    return suggest_near_name(name, known) or "one of " + ", ".join(known)


def suggest_near_name(name: str, known: list[str]) -> str:
    """Return a phrase with the known name nearest to `name`, one that begins with it first, or an empty text."""
    simplified = {_simplify(each): each for each in known}
    longer = [each for each in simplified if len(name) > 1 and each.startswith(_simplify(name))]
    match = get_close_matches(_simplify(name), longer, n=1, cutoff=0.0)
    match = match or get_close_matches(_simplify(name), simplified, n=1, cutoff=0.6)
    return f"nearest is '{simplified[match[0]]}'" if match else ""


def _simplify(name: str) -> str:
    """Return a name as names are compared: DRY-RUN is dry_run."""
    return name.casefold().replace("-", "_")


def build_nothing_raised_error(where: str, reason: str, expected: str) -> InputError:
    """Build the error (raises_nothing) of a stimulus that raises no pixel, with the reason."""
    return InputError(where, Unquoted(f"a stimulus that raises nothing: {reason}"), expected, code="raises_nothing")


class Unquoted:
    """Text that an error message shows without quotes."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text


MISSING = Unquoted("missing")
"""The value of invalid input that was not given."""
