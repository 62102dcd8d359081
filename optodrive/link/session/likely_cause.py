"""Why a link went, or a lease lapsed: the likeliest cause in one plain sentence, with what to do."""

from dataclasses import dataclass

from optodrive.link.protocol.describe import describe_reset_cause
from optodrive.link.transport.port_state import PortState

STALL_LEASE_FRACTION = 0.8
"""The lease is renewed at a fifth of its length: a stall of the rest lets it lapse."""
RESET_REMEDIES = {
    "power-up": "its supply was switched off or unplugged; check plug and supply",
    "reset": "its reset was pressed, or the debugger or USB reset it; arm again when that is over",
    "brown-out": "its supply sagged; give board and laser a stronger supply, or separate ones",
    "watchdog": "its firmware hung; update the firmware, and keep the capture of the link (serve --capture)",
}
NOISE_REMEDY = "check cable, plugs and grounding, keep the cable from the laser's and mirrors' drivers"


@dataclass(frozen=True)
class LinkEvidence:
    """What is known when a link fails; counts and stall of the last seconds only.

    bad_here, bad_at_board: frames that arrived damaged; stall_s: the longest gap between turns of the host's loop
    silent: nothing came for long, rather than an error of the port; planner_stuck: the lease was withheld
    """

    port: str
    port_state: PortState
    silent: bool
    lease_s: float
    stall_s: float = 0.0
    host_bad_frames: int = 0
    board_bad_frames: int = 0
    retransmitted: int = 0
    naks: int = 0
    planner_stalled: bool = False


def diagnose_port(port: str, state: PortState) -> str | None:
    """A cause that the port alone tells; None where it is there and free."""
    if state.status == "missing":
        others = (
            f"; {', '.join(state.other_ports)} there instead, perhaps the same board: " if state.other_ports else "; "
        )
        return (
            f"{port} is gone: unplugged, without power, or come back under another name{others}"
            "check the plug, and name the port by /dev/serial/by-id"
        )
    if state.status == "denied":
        return f"{port} may not be opened by this user: join its group (often dialout) and log in again"
    if state.status == "in_use":
        return f"{port} is held by {'; '.join(map(str, state.holders))}: end that program"
    return None


def diagnose_link_loss(evidence: LinkEvidence) -> str:
    """Why the link was lost."""
    port_message = diagnose_port(evidence.port, evidence.port_state)
    if port_message is not None:
        return port_message
    if not evidence.silent:
        return describe_replug(evidence.port)
    return (
        _diagnose_host_stall(evidence)
        or _diagnose_corruption(evidence)
        or (
            f"nothing comes from the board though {evidence.port} is open and nothing arrived damaged: "
            "it hangs, restarts, has no power, or cannot read what reaches it; look at supply, lamps and cable"
        )
    )


def diagnose_lease_expiry(evidence: LinkEvidence) -> str:
    """Why the board heard no lease in time while the link stood."""
    return (
        _diagnose_host_stall(evidence)
        or _diagnose_planner_stall(evidence)
        or _diagnose_corruption(evidence)
        or (
            "the host kept its time and nothing arrived damaged: bytes were held up on the way; "
            "use a port of its own rather than a hub, and run `optodrive doctor`"
        )
    )


def _diagnose_host_stall(evidence: LinkEvidence) -> str | None:
    if evidence.stall_s < STALL_LEASE_FRACTION * evidence.lease_s:
        return None
    return (
        f"this computer stood still for {evidence.stall_s * 1e3:.0f} ms, the lease is {evidence.lease_s * 1e3:.0f} ms: "
        "suspended, swapping or overloaded; end other work on it, and run `optodrive doctor`"
    )


def _diagnose_planner_stall(evidence: LinkEvidence) -> str | None:
    if not evidence.planner_stalled:
        return None
    return "the planner made no progress and the lease was withheld: send smaller plans, or look at the last one"


def _diagnose_corruption(evidence: LinkEvidence) -> str | None:
    bad_frames = evidence.host_bad_frames + evidence.board_bad_frames
    if bad_frames:
        return (
            f"bytes arrive damaged ({evidence.host_bad_frames} bad frames here, {evidence.board_bad_frames} at the board "
            f"in the last seconds): {NOISE_REMEDY}, and compare board.baud"
        )
    if evidence.naks or evidence.retransmitted:
        return (
            f"bytes are lost on the way ({evidence.retransmitted} frames sent again, {evidence.naks} refused): "
            "a hub or a converter cannot keep up; use a port of its own, or a lower board.baud"
        )
    return None


def describe_replug(port: str) -> str:
    """A port that failed and can be opened again, on a board that did not restart."""
    return f"{port} went away and is there again: replugged, or a hub's fault; check the plug, the cable and the hub"


def describe_receive_errors(board_bad_frames: int) -> str:
    """What a board says that fell silent, did not restart, and counted damaged frames meanwhile."""
    return f"what was sent reached the board damaged ({board_bad_frames} bad frames there): {NOISE_REMEDY}"


def describe_restart(cause_code: int, uptime_s: float) -> str:
    """What a board says that was started anew while the link was down."""
    cause_text = describe_reset_cause(cause_code)
    remedy = RESET_REMEDIES.get(cause_text, "look at its log")
    return f"the board restarted {uptime_s:.1f} s before it answered again ({cause_text}): {remedy}"
