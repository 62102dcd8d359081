"""Most likely cause of a lost link or an expired lease, in one sentence with a remedy."""

from dataclasses import dataclass
from math import inf

from optodrive.core.quantity import format_quantity
from optodrive.link.protocol.describe import describe_reset_cause
from optodrive.link.transport.port_state import PortState

STALL_LEASE_FRACTION = 0.8
"""Stall, as a fraction of the lease, that lets it expire. The host renews it after a fifth of its length."""
RESET_REMEDIES = {
    "power-up": "its supply was switched off or unplugged; check the plug and the supply",
    "reset": "a button, a debugger or USB reset it; arm it again afterwards",
    "brown-out": "its supply voltage dropped; use a stronger supply, or separate ones for board and laser",
    "watchdog": "its firmware hung; update it, and keep a capture of the link (serve --capture)",
}
NOISE_REMEDY = "check cable, plugs and grounding, keep the cable away from the drivers of laser and mirrors"


@dataclass(frozen=True)
class LinkEvidence:
    """Evidence at the failure of a link. Counts and stall cover the last seconds only.

    silent: whether the board stopped answering, rather than the port reporting an error
    stall_s: longest time between two iterations of the host's loop
    host_bad_frames, board_bad_frames: frames received damaged
    gaps: frames that the board refused because one before them was missing
    stalled: process without whose progress the lease was withheld for withheld_s, '' for none
    port_fault: what the open port shows, as the transport describes it, '' for nothing
    slowest_answer_s: longest time to the board's answer to a question
    rto_s: time without an acknowledgement after which a frame is sent again
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
    gaps: int = 0
    stalled: str = ""
    withheld_s: float = 0.0
    port_fault: str = ""
    slowest_answer_s: float = 0.0
    rto_s: float = inf


def diagnose_port(port: str, state: PortState) -> str | None:
    """Return a cause evident from the port alone, None if it is available."""
    if state.status == "missing":
        others = ", ".join(state.other_ports)
        found = f"; found {others} instead, possibly the same board: " if others else "; "
        return (
            f"{port} is missing: unplugged, without power, or reconnected under another name{found}"
            "check the plug, and configure the port by the name in /dev/serial that `optodrive doctor` recommends"
        )
    if state.status == "denied":
        return f"this user may not open {port}: join its group (often dialout) and log in again"
    if state.status == "in_use":
        return f"{port} is in use by {'; '.join(map(str, state.holders))}: end that program"
    return None


def diagnose_link_loss(evidence: LinkEvidence) -> str:
    """Return the likely cause of a lost link."""
    port_message = diagnose_port(evidence.port, evidence.port_state)
    if port_message is not None:
        return port_message
    if evidence.port_fault:
        return evidence.port_fault
    if not evidence.silent:
        return (
            f"{evidence.port} failed while it was open and is still there: its adapter, driver or hub failed, it was "
            "unplugged for an instant, or another program reads from it; which of these is not known"
        )
    return (
        _diagnose_host_stall(evidence)
        or _diagnose_corruption(evidence)
        or (
            f"the board does not answer although {evidence.port} is open and no frame arrived damaged: it hangs, "
            "restarts, has no power, or receives only damaged frames; check its supply, indicators and cable"
        )
    )


def diagnose_lease_expiry(evidence: LinkEvidence) -> str:
    """Return the likely cause of an expired lease while the link was up."""
    return (
        _diagnose_host_stall(evidence)
        or _diagnose_process_stall(evidence)
        or evidence.port_fault
        or _diagnose_corruption(evidence)
        or (
            "the host was on time and no frame arrived damaged: bytes were delayed on the link; "
            "use a dedicated port instead of a hub, and run `optodrive doctor`"
        )
    )


def _diagnose_host_stall(evidence: LinkEvidence) -> str | None:
    if evidence.stall_s < STALL_LEASE_FRACTION * evidence.lease_s:
        return None
    stall, lease = format_quantity(evidence.stall_s, "s"), format_quantity(evidence.lease_s, "s")
    return (
        f"this computer stalled for {stall}, the lease is {lease}: "
        "suspended, swapping or overloaded; end other work on it, and run `optodrive doctor`"
    )


def _diagnose_process_stall(evidence: LinkEvidence) -> str | None:
    if not evidence.stalled or evidence.withheld_s < STALL_LEASE_FRACTION * evidence.lease_s:
        return None
    if evidence.stalled == "web":
        return "the web process did not respond and the lease was withheld: see the daemon's log"
    return "the planner made no progress and the lease was withheld: submit smaller plans, or check the last one"


def _diagnose_corruption(evidence: LinkEvidence) -> str | None:
    bad_frames = evidence.host_bad_frames + evidence.board_bad_frames
    if bad_frames:
        return (
            f"bytes arrive damaged ({evidence.host_bad_frames} bad frames at the host, "
            f"{evidence.board_bad_frames} at the board in the last seconds): {NOISE_REMEDY}, and check board.baud"
        )
    late = ""
    if evidence.slowest_answer_s > evidence.rto_s:
        late = f"answers take up to {format_quantity(evidence.slowest_answer_s, 's')}"
    if evidence.gaps:
        return (
            f"bytes are lost on the link ({evidence.retransmitted} frames retransmitted, {evidence.gaps} refused after "
            f"a gap{f', {late}' if late else ''}): a hub or a converter is too slow; use a dedicated port, or a lower "
            "board.baud"
        )
    if late:
        return (
            f"the link delays bytes: {late}, frames are sent again after {format_quantity(evidence.rto_s, 's')}, and "
            "no byte is known to be lost; connect the board directly, not by a hub, a network or a virtual machine, "
            "and see the latency timer in `optodrive doctor`"
        )
    if evidence.retransmitted:
        return (
            f"{evidence.retransmitted} frames were sent again because no acknowledgement came in time: bytes are lost "
            "or late, which of the two is not known; use a dedicated port, or a lower board.baud"
        )
    return None


def describe_receive_errors(board_bad_frames: int) -> str:
    """Return the cause for a board that did not answer, did not restart and counted damaged frames meanwhile."""
    return f"bytes reached the board damaged ({board_bad_frames} bad frames there): {NOISE_REMEDY}"


def describe_restart(cause_code: int, uptime_s: float) -> str:
    """Return the cause for a board that restarted while the link was down."""
    cause_text = describe_reset_cause(cause_code)
    remedy = RESET_REMEDIES.get(cause_text, "see its log")
    return f"the board restarted {uptime_s:.1f} s before it answered again ({cause_text}): {remedy}"
