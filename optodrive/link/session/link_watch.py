"""Monitor of a link and its service loop, and the most likely cause of its failure, in one sentence with a remedy."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

from optodrive.core.quantity import format_quantity
from optodrive.link.protocol.transcript import describe_reset_cause
from optodrive.link.transport.port_state import PortState, describe_replug, read_port_state

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


EVIDENCE_WINDOW_S = 5.0
"""Only events of this last period count as evidence."""
SAMPLE_INTERVAL_S = 0.5


BOARD_COUNTER_MODULUS = 2**16
"""The board's counters begin again at 0 here."""


class LinkErrorCounts(NamedTuple):
    """Error counts of a link since it was opened. board_bad_frames: of the board, modulo BOARD_COUNTER_MODULUS."""

    host_bad_frames: int = 0
    board_bad_frames: int = 0
    retransmitted: int = 0
    naks: int = 0
    gaps: int = 0

    def count_since(self, then: "LinkErrorCounts") -> "LinkErrorCounts":
        """Return the errors counted since an earlier time."""
        counts = LinkErrorCounts(*(now - before for now, before in zip(self, then, strict=True)))
        return counts._replace(board_bad_frames=counts.board_bad_frames % BOARD_COUNTER_MODULUS)


class LinkCause(NamedTuple):
    """Likely cause in one sentence, and the host time at which the failure was noticed, s."""

    message: str
    noticed_s: float


class LinkWatch:
    """Monitor of one link. The session's loop calls it. Any thread may read `cause` and `longest_stall_s`.

    rto_s: retransmission timeout; describe_fault: of the transport
    """

    def __init__(
        self, port: str, lease_s: float, rto_s: float = inf, describe_fault: Callable[[], str] = lambda: ""
    ) -> None:
        self.cause: LinkCause | None = None
        self.longest_stall_s = 0.0
        self._port = port
        self._lease_s = lease_s
        self._rto_s = rto_s
        self._describe_fault = describe_fault
        self._answers: deque[tuple[float, float]] = deque()
        self._last_loop_s: float | None = None
        self._withheld_from_s = self._withheld_until_s = -inf
        self._stalled = ""
        self._is_withheld = False
        self._stall_s, self._stall_at_s = 0.0, 0.0
        self._samples: deque[tuple[float, LinkErrorCounts]] = deque()
        self._counts = LinkErrorCounts()
        self._fault = ""
        self._last_received_s: float | None = None
        self._counts_at_loss: LinkErrorCounts | None = None
        self._port_missing = False

    def on_opened(self) -> None:
        """Reset the counters after the link was opened. The time for connecting is no stall."""
        self._samples.clear()
        self._answers.clear()
        self._counts, self._last_loop_s, self._fault = LinkErrorCounts(), None, ""

    def on_loop(self, now_s: float, stalled: str, counts: LinkErrorCounts) -> None:
        """Record one loop iteration. stalled: process because of which the lease is not renewed, '' for none."""
        self._record_stall(now_s)
        if stalled and not self._is_withheld:
            self._withheld_from_s = now_s if self._last_loop_s is None else self._last_loop_s
        if stalled or self._is_withheld:
            self._withheld_until_s = now_s
        self._stalled = stalled or self._stalled
        self._is_withheld = bool(stalled)
        self._last_loop_s = now_s
        self._counts = counts
        if not self._samples or now_s - self._samples[-1][0] >= SAMPLE_INTERVAL_S:
            self._samples.append((now_s, counts))
        while now_s - self._samples[0][0] > EVIDENCE_WINDOW_S:
            self._samples.popleft()

    def _record_stall(self, now_s: float) -> None:
        if self._last_loop_s is None:
            return
        stall_s = now_s - self._last_loop_s
        self.longest_stall_s = max(self.longest_stall_s, stall_s)
        if stall_s >= self._stall_s or now_s - self._stall_at_s > EVIDENCE_WINDOW_S:
            self._stall_s, self._stall_at_s = stall_s, now_s

    def on_answer(self, now_s: float, duration_s: float) -> None:
        """Record how long the board's answer to a question took."""
        self._answers.append((now_s, duration_s))
        while now_s - self._answers[0][0] > EVIDENCE_WINDOW_S:
            self._answers.popleft()

    def on_status(self, fault: str, now_s: float, counts: LinkErrorCounts) -> None:
        """Record the board's fault, '' for none, and explain an expired lease."""
        # A fault that was present before the first iteration is from an unobserved time.
        if fault == "LINK" and self._fault != fault and self._last_loop_s is not None:
            self._record_stall(now_s)  # the stall may lie within this iteration
            self._counts = counts
            self.cause = LinkCause(
                diagnose_lease_expiry(self._collect_evidence(now_s, PortState("available"), silent=False)), now_s
            )
        self._fault = fault

    def on_lost(self, now_s: float, last_received_s: float, silent: bool) -> LinkCause:
        """Return the likely cause of a lost link.

        last_received_s: time of the last message from the board
        silent: whether the link was closed because the board did not answer
        """
        self._last_received_s = last_received_s
        self._counts_at_loss = self._counts if silent else None
        state = read_port_state(self._port)
        self._port_missing = state.status == "missing"
        self.cause = LinkCause(diagnose_link_loss(self._collect_evidence(now_s, state, silent)), now_s)
        return self.cause

    def on_false_report(self, message: str, now_s: float) -> None:
        """Record a report of the board that cannot be, because of which the link was closed."""
        self.cause = LinkCause(message, now_s)

    def on_reconnect_failed(self, now_s: float) -> None:
        """Update the cause from the port's state after a failed attempt to reconnect."""
        state = read_port_state(self._port)
        self._port_missing = self._port_missing or state.status == "missing"
        message = diagnose_port(self._port, state)
        if message is not None and (self.cause is None or self.cause.message != message):
            self.cause = LinkCause(message, now_s)

    def on_reconnected(self, now_s: float, reset_code: int, uptime_s: float, counts: LinkErrorCounts) -> None:
        """Update the cause after the link was reopened.

        The board has restarted if its uptime is shorter than the time since its last message.
        """
        since = None if self._counts_at_loss is None else counts.count_since(self._counts_at_loss)
        if self._last_received_s is not None and uptime_s < now_s - self._last_received_s:
            self.cause = LinkCause(describe_restart(reset_code, uptime_s), now_s)
        elif since is not None and since.board_bad_frames:
            self.cause = LinkCause(describe_receive_errors(since.board_bad_frames), now_s)
        elif self._port_missing:
            self.cause = LinkCause(describe_replug(self._port), now_s)
        self._last_received_s = self._counts_at_loss = None
        self._port_missing = False

    def _collect_evidence(self, now_s: float, state: PortState, silent: bool) -> LinkEvidence:
        oldest = self._samples[0][1] if self._samples else LinkErrorCounts()
        recent = self._counts.count_since(oldest)
        until_s = now_s if self._is_withheld else self._withheld_until_s
        is_recent = now_s - until_s < self._lease_s + SAMPLE_INTERVAL_S
        return LinkEvidence(
            port=self._port,
            port_state=state,
            silent=silent,
            lease_s=self._lease_s,
            stall_s=self._stall_s if now_s - self._stall_at_s <= EVIDENCE_WINDOW_S else 0.0,
            stalled=self._stalled if is_recent else "",
            withheld_s=until_s - self._withheld_from_s if is_recent else 0.0,
            port_fault=self._describe_fault(),
            slowest_answer_s=max((duration_s for _, duration_s in self._answers), default=0.0),
            rto_s=self._rto_s,
            **recent._asdict(),
        )
