"""A plan's report with the display's layout, which gives the heights of its pixels and a picture."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

import numpy as np
from pydantic import PrivateAttr

from optodrive.core.errors import InputError, RefusedError
from optodrive.core.types.arrays import FloatArray
from optodrive.core.types.push_options import check_keywords
from optodrive.daemon.responses.plan import PlanReport
from optodrive.device.config import PixelLayout


@check_keywords
class Plan(PlanReport):
    """A plan as the daemon reports it, placed on the display."""

    _layout: PixelLayout | None = PrivateAttr(default=None)

    def place_on(self, layout: PixelLayout) -> Self:
        """Set the layout of the plan's pixels and return the plan."""
        self._layout = layout
        return self

    @property
    def heights_um(self) -> FloatArray | None:
        """Largest displacement of each pixel, [p] in µm: simulated from executed pulses if available, else predicted.

        None if the report lists no pulses.
        """
        executed = self.executed_pulses
        if self._layout is None:
            return None
        if executed is not None and executed.simulated_um:
            pixel, height_um = executed.pixel, executed.simulated_um
        elif self.pulses is not None:
            pixel, height_um = self.pulses.pixel, self.pulses.predicted_um
        else:
            return None
        heights_um = np.zeros(len(self._layout))
        np.maximum.at(heights_um, np.asarray(pixel, dtype=np.int64), np.asarray(height_um, dtype=np.float64))
        return heights_um

    def raise_if_failed(self) -> Self:
        """Return the plan. Raise RefusedError if it failed or was stopped."""
        if self.status in ("failed", "stopped"):
            raise RefusedError(f"plan {self.plan} {self.status}: {self.error}")
        return self

    def __repr__(self) -> str:
        heights_um = self.heights_um
        highest = "" if heights_um is None else f", up to {heights_um.max():.1f} µm"
        return f"<Plan {self.plan} {self.name!r}: {self.status}, {self.executed} of {self.planned} pulses{highest}>"

    __str__ = __repr__

    def _repr_png_(self) -> bytes | None:
        """Draw the heights on the display, for notebooks."""
        heights_um = self.heights_um
        if heights_um is None or self._layout is None:
            return None
        from optodrive.client.heights import render_png

        return render_png(self._layout, heights_um)


@contextmanager
def report_loss(plan_id: str) -> Iterator[None]:
    """Raise RefusedError if the daemon no longer knows a plan that it has accepted: its planner process has ended."""
    try:
        yield
    except InputError as error:
        if error.code != "plan_not_found":
            raise
        raise RefusedError(f"plan {plan_id} failed: the planner process has ended, and the board is dark") from None
