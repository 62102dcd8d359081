"""The pulses of a plan as a report lists them, in few bytes."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from optodrive.core.quantity import m_to_um
from optodrive.core.types.arrays import FloatArray, StrArray
from optodrive.planning.planned_sequence import PlannedSequence
from optodrive.planning.summary_schema import PulseColumns

PULSES_LISTED_MAX = 20_000
"""The largest number of pulses that a response lists one by one."""
UInt8Array = np.ndarray[tuple[int, ...], np.dtype[np.uint8]]
Int32Array = np.ndarray[tuple[int, ...], np.dtype[np.int32]]


@dataclass(frozen=True, eq=False)
class PulseTable:
    """Columns of a plan's pulses, [n], with names and units as in `LimitedPlan` and `PlannedSequence`.

    reason: index into reasons
    """

    start_s: FloatArray
    width_s: FloatArray
    power_w: FloatArray
    pixel: Int32Array
    stage: UInt8Array
    energy_j: FloatArray
    trimmed_j: FloatArray
    target_m: FloatArray
    predicted_m: FloatArray
    reason: UInt8Array
    reasons: tuple[str, ...]

    @classmethod
    def from_planned(cls, planned: PlannedSequence) -> Self | None:
        """Return the columns of a plan, None if it has more than PULSES_LISTED_MAX pulses."""
        plan = planned.plan
        if len(plan) > PULSES_LISTED_MAX:
            return None
        reasons = ("", *_list_reasons(plan.reason))
        reason = np.zeros(len(plan), dtype=np.uint8)
        for index, name in enumerate(reasons[1:], 1):
            reason[plan.reason == name] = index
        return cls(
            start_s=_detach(plan.start_s),
            width_s=_detach(plan.width_s),
            power_w=_detach(plan.power_w),
            pixel=plan.pixel.astype(np.int32),
            stage=plan.stage.astype(np.uint8),
            energy_j=_detach(plan.energy_j),
            trimmed_j=_detach(plan.trimmed_j),
            target_m=_detach(plan.target_m),
            predicted_m=_detach(planned.predicted_m),
            reason=reason,
            reasons=reasons,
        )

    def __len__(self) -> int:
        return len(self.start_s)

    @cached_property
    def nbytes(self) -> int:
        """Size of all columns, bytes."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, np.ndarray))

    def to_columns(self) -> PulseColumns:
        """Convert the columns to the units of a response."""
        return PulseColumns(
            start_s=self.start_s.tolist(),
            width_s=self.width_s.tolist(),
            power_w=self.power_w.tolist(),
            pixel=self.pixel.tolist(),
            stage=self.stage.tolist(),
            energy_j=self.energy_j.tolist(),
            trimmed_j=self.trimmed_j.tolist(),
            reason=[self.reasons[index] for index in self.reason.tolist()],
            target_um=[value if np.isfinite(value) else None for value in m_to_um(self.target_m).tolist()],
            predicted_um=m_to_um(self.predicted_m).tolist(),
        )


def _detach(column: FloatArray) -> FloatArray:
    """Return the column without the larger array of which it is a part."""
    return column if column.base is None else column.copy()


def _list_reasons(reason: StrArray) -> list[str]:
    names: list[str] = np.unique(reason[reason != ""]).tolist()
    return names
