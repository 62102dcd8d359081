"""Checks of the board by a handshake, without arming it."""

from optodrive.cli.output import Finding, report_ok, report_problem, report_warning
from optodrive.core.clock import Clock
from optodrive.core.errors import InputError, LinkError
from optodrive.device.config import Config
from optodrive.link.board_setup import build_board_requirements, build_port_settings
from optodrive.link.protocol.messages import INPUTS
from optodrive.link.session.board_view import get_fault_hint
from optodrive.link.session.session import BoardSession
from optodrive.link.transport.registry import find_transport_factory
from optodrive.planning.display_model import DisplayModel
from optodrive.planning.heat_record import BOARDS, join_uids, read_heat

ROUND_TRIP_WARNING_S = 0.01
UNANSWERED = "check power, port and baud rate"
SAFE_INPUTS = {"interlock": True, "key": True, "estop": False}
UNSAFE_REASONS = {
    "interlock": "the enclosure is open",
    "key": "the key is off",
    "estop": "the emergency stop is pressed",
}


def check_board(config: Config, clock: Clock, is_part: bool = False) -> list[Finding]:
    """Connect to the board, compare its limits with the configuration, measure the round trip, and stay DISARMED.

    is_part: whether other boards draw on the same display
    """
    transport = find_transport_factory(build_port_settings(config))()
    session = BoardSession(transport, clock, build_board_requirements(config))
    try:
        session.connect()
        trip_s = session.collect_link_stats()["round_trip_ms"] * 1e-3
        findings = [*_check_identity(session, config), check_inputs(session.board.inputs), check_trip(trip_s)]
        identity = join_uids([session.board.uid])
        if identity and not is_part:
            findings.append(check_heat(BOARDS, identity, config, clock))
        return findings
    except (LinkError, InputError) as error:
        return [describe_failure(error)]
    finally:
        session.close()


def describe_failure(error: LinkError | InputError) -> Finding:
    """Return the finding on a board that does not answer, or that answers something else than expected."""
    if isinstance(error, LinkError):
        return report_problem("board", str(error), UNANSWERED)
    observation = f"does not fit the configuration: {error.where} is {error.value}"
    return report_problem("board", observation, f"expected: {error.expected}")


def _check_identity(session: BoardSession, config: Config) -> list[Finding]:
    board = session.board
    observation = f"uid {board.uid}, firmware {board.firmware >> 16}.{board.firmware & 0xFFFF}, {board.state}"
    limits = report_ok("limits", "the board's limits allow the configuration")
    if board.fault:
        return [report_warning("board", f"{observation} {board.fault}", get_fault_hint(board.fault)), limits]
    if config.board.transport == "simulated":  # with a new one in every run, of the same uid
        return [report_ok("board", f"{observation}; the board is simulated"), limits]
    if not config.board.uid:
        return [
            report_warning(
                "board",
                f"{observation}; the configuration accepts any board",
                f'to accept this board only: uid = "{board.uid}" in section [board]',
            ),
            limits,
        ]
    return [report_ok("board", observation), limits]


def check_heat(kind: str, identity: str | None, config: Config, clock: Clock) -> Finding:
    """Return the finding on the record of the display's heat. Arguments as for `HeatRecord`."""
    is_recorded, observation = read_heat(kind, identity, DisplayModel.from_config(config), clock)
    if is_recorded:
        return report_ok("heat", "the display's heat after the last run is recorded on this machine")
    remedy = "wait, or use less light; for every run alike: let all users write the record"
    return report_warning("heat", f"the display counts as {observation}", remedy)


def check_inputs(inputs: int) -> Finding:
    """Return the finding on the bits of the inputs."""
    input_states = {name: bool(inputs >> bit & 1) for bit, name in enumerate(INPUTS)}
    unsafe = [UNSAFE_REASONS[name] for name in INPUTS if input_states[name] != SAFE_INPUTS[name]]
    if unsafe:
        return report_warning("inputs", "; ".join(unsafe), "the board refuses to arm until this is corrected")
    return report_ok("inputs", "enclosure closed, key on, emergency stop released")


def check_trip(trip_s: float) -> Finding:
    """Return the finding on the shortest round trip."""
    observation = f"round trip {trip_s * 1e3:.2f} ms"
    if trip_s > ROUND_TRIP_WARNING_S:
        return report_warning(
            "link", observation, "slow: see latency above, and connect the board directly rather than through a hub"
        )
    return report_ok("link", observation)
