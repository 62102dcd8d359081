"""The only door to the wire: points whose bytes were decoded again and verified against the budget.

Theory of operation. A plan that the limiter has passed is not yet safe to send: quantisation rounds it, and a fault in
the encoder, or in memory, may change what the board receives. So the very bytes are decoded by code that the encoder
does not share, and the pulses that a board would emit are verified as if nobody had limited them. The checksum over
these bytes goes with them: the link process sends only bytes that still have it (`service/point_handover.py`).
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import NamedTuple

from optodrive.core.types.plans import BudgetState, PulsePlan
from optodrive.link.protocol.quantisation import DecodedPulses, WireScale
from optodrive.link.protocol.stage_points import StagePoints, decode_stages
from optodrive.planning.limiter.budget import Budget
from optodrive.planning.limiter.limiter import verify


class ProvenPoints(NamedTuple):
    """Points that may be handed over.

    crc: CRC-32 of the bytes that were verified; pulses: these bytes decoded, [n], times from the plan's zero
    """

    points: StagePoints
    crc: int
    pulses: DecodedPulses


def prove(
    plan: PulsePlan,
    points: StagePoints,
    scales: Sequence[WireScale],
    state: BudgetState,
    budget: Budget,
    on_progress: Callable[[], None] = lambda: None,
    first_row: int = 0,
) -> ProvenPoints:
    """Return the points of a plan with the proof. Raise LocalProtocolError if a pulse exceeds a cap.

    scales: of each stage; state: before row `first_row` of the plan, whose earlier rows were proven before
    """
    payload = points.encode_payload()
    row, pulses = decode_stages(payload, points, scales)
    if first_row:
        # All bytes are decoded, but a row that was proven counts already: it is in the state.
        is_new = row >= first_row
        plan = PulsePlan(**{item.name: getattr(plan, item.name)[first_row:] for item in fields(PulsePlan)})
        row = row[is_new] - first_row
        pulses = DecodedPulses(**{name: column[is_new] for name, column in vars(pulses).items()})
    verify(plan, row, pulses, state, budget, on_progress)
    return ProvenPoints(points, zlib.crc32(payload), pulses)
