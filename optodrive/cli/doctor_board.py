"""What the doctor asks the board itself: a handshake and nothing more; it is never armed."""

from optodrive.cli.doctor_finding import Finding, ok, problem, warning
from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError
from optodrive.device.config import Config
from optodrive.link.protocol.messages import INPUTS
from optodrive.link.session.board_requirements import Requirements
from optodrive.link.session.fault_hints import hint
from optodrive.link.session.session import Session
from optodrive.link.transport.registry import transport_maker

ROUND_TRIP_NOTICED_S = 0.01
SAFE_INPUTS = {"interlock": True, "key": True, "estop": False}
UNSAFE = {"interlock": "the enclosure is open", "key": "the key is off", "estop": "the emergency stop is pressed"}


def check_board(config: Config, clock: Clock) -> list[Finding]:
    """Greet the board, hold its limits against the configuration's, measure the round trip, and leave it DISARMED."""
    board = config.board
    session = Session(transport_maker(board)(), clock, Requirements.of(config))
    try:
        session.connect()
        return [*_identity(session, config), _inputs(session), _round_trip(session)]
    except LinkError as error:
        return [problem("board", str(error), "check power, port and board.baud")]
    except InputError as error:
        return [problem("board", f"{error.where} is {error.value}", f"expected: {error.expected}")]
    finally:
        session.close()


def _identity(session: Session, config: Config) -> list[Finding]:
    board = session.board
    seen = f"uid {board.uid}, firmware {board.firmware >> 16}.{board.firmware & 0xFFFF}, {board.state}"
    limits = ok("limits", "the board's own allow what the configuration asks for")
    if board.fault:
        return [warning("board", f"{seen} {board.fault}", hint(board.fault)), limits]
    if not config.board.uid:
        return [warning("board", f"{seen}; any board would do", f'to be sure of it: board.uid = "{board.uid}"'), limits]
    return [ok("board", seen), limits]


def _inputs(session: Session) -> Finding:
    now = {name: bool(session.board.inputs >> bit & 1) for bit, name in enumerate(INPUTS)}
    wrong = [UNSAFE[name] for name in INPUTS if now[name] != SAFE_INPUTS[name]]
    if wrong:
        return warning("inputs", "; ".join(wrong), "the board will not arm before that is put right")
    return ok("inputs", "enclosure closed, key on, emergency stop released")


def _round_trip(session: Session) -> Finding:
    trip_ms = session.link_figures()["round_trip_ms"]
    seen = f"round trip {trip_ms:.2f} ms"
    if trip_ms > ROUND_TRIP_NOTICED_S * 1e3:
        return warning("link", seen, "slow: see latency above, and use a port of its own rather than a hub")
    return ok("link", seen)
