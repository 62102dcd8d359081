"""Walls warm the walls beside them, and the frame cools the rim."""

import numpy as np

from optodrive.physics.term import HeatFlows, StateView, Term, TermParameter, TermValues


class LateralConduction(Term):
    """(w − w') / resistance between neighbours, w / frame_resistance at each edge on the frame."""

    key = "lateral_conduction"
    requires = ("wall_heating",)
    parameters = (
        TermParameter("resistance", "K/W", 430.0, 40.0, 10_000.0, "neighbours rise by 0.002 to 0.1 of a wall's rise"),
        TermParameter("frame_resistance", "K/W", 430.0, 40.0, 10_000.0, "as between neighbours"),
    )

    def add_flows(self, values: TermValues, view: StateView, flows: HeatFlows) -> None:
        """Between walls, and from the rim to the frame."""
        if view.neighbours is None:
            return
        wall_k, beside = view.rise_k["wall_k"], view.neighbours.indices
        there = beside >= 0
        other_k = np.where(there, wall_k[beside], 0.0)
        sent_w = (there.sum(axis=1) * wall_k - other_k.sum(axis=1)) / values["resistance"]
        # What one wall sends another receives: the sum over all pixels is zero, nothing leaves.
        flows.into_w["wall_k"] = flows.into_w.get("wall_k", 0.0) - sent_w
        flows.add_flow("wall_k", None, view.neighbours.frame_edges * wall_k / values["frame_resistance"])


TERM = LateralConduction()
