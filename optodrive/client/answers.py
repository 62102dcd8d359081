"""What the daemon answers, typed; `answer` keeps all of it."""

from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np

from optodrive.client.http import JsonObject, build_error
from optodrive.core.errors import OptodriveError, RefusedError
from optodrive.core.types.arrays import FloatArray, freeze_arrays
from optodrive.device.config import PixelLayout
from optodrive.link.protocol.states import ARMED_STATES

UNFINISHED_STATUSES = ("queued", "running")


class State(NamedTuple):
    """The daemon's state. board: DISARMED, ARMING, ARMED, …; fault, hint: what is wrong and what to do; answer: all."""

    display: str
    pixels: int
    board: str
    fault: str | None
    hint: str
    link: str
    waiting: int
    running: str | None
    underruns: int
    answer: JsonObject

    @classmethod
    def from_response(cls, answer: JsonObject) -> Self:
        """From GET /v1/state."""
        board, queue = answer["board"], answer["queue"]
        return cls(
            display=answer["display"],
            pixels=answer["pixels"],
            board=board["state"],
            fault=board["fault"],
            hint=board["hint"],
            link=answer["link"]["state"],
            waiting=queue["waiting"],
            running=queue["running"],
            underruns=board["underruns"],
            answer=answer,
        )

    @property
    def armed(self) -> bool:
        """Whether the board takes plans."""
        return self.board in ARMED_STATES


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan: asked for, planned, executed.

    fits: whether all of it fits on the beam, None where that was not asked (a stream)
    heights_um: [p] tallest peak of each pixel, reckoned from what was executed where that is known, else predicted;
    None where the daemon did not list the pulses
    """

    plan_id: str
    name: str
    status: str
    error: str | None
    planned: int
    sent: int
    executed: int
    dropped: int
    fits: bool | None
    duration_s: float
    heights_um: FloatArray | None
    layout: PixelLayout
    answer: JsonObject

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @classmethod
    def from_response(cls, answer: JsonObject, layout: PixelLayout) -> Self:
        """From an answer of /v1/plans or /v1/patterns."""
        feasibility = answer["summary"]["feasibility"]
        return cls(
            plan_id=answer["plan"],
            name=answer["name"],
            status=answer["status"],
            error=answer["error"],
            planned=answer["planned"],
            sent=answer["sent"],
            executed=answer["executed"],
            dropped=answer["dropped"],
            fits=None if feasibility is None else feasibility["fits"],
            duration_s=answer["summary"]["duration_s"],
            heights_um=_max_heights_um(answer, len(layout)),
            layout=layout,
            answer=answer,
        )

    @property
    def ended(self) -> bool:
        """Whether nothing more will happen to it."""
        return self.status not in UNFINISHED_STATUSES

    @property
    def trimmed(self) -> int:
        """Pulses that the limiter took energy from."""
        return int(self.answer["summary"]["trimmed"]["pulses"])

    @property
    def predicted_max_um(self) -> float:
        """The tallest peak predicted, µm."""
        return float(self.answer["summary"]["predicted_max_um"])

    @property
    def simulated_max_um(self) -> float | None:
        """The tallest peak reckoned from what was executed, µm; None before that is known."""
        value = self.answer["simulated_max_um"]
        return None if value is None else float(value)

    def raise_if_failed(self) -> Self:
        """Itself; RefusedError where it failed."""
        if self.status == "failed":
            raise RefusedError(f"plan {self.plan_id} failed: {self.error}")
        return self

    def __repr__(self) -> str:
        max_height = "" if self.heights_um is None else f", tallest {self.heights_um.max():.1f} µm"
        return (
            f"<Plan {self.plan_id} {self.name!r}: {self.status}, {self.executed} of {self.planned} pulses{max_height}>"
        )

    def _repr_png_(self) -> bytes | None:
        """For notebooks: its heights on the display."""
        if self.heights_um is None:
            return None
        from optodrive.client.picture import render_png

        return render_png(self.layout, self.heights_um)


def _max_heights_um(answer: JsonObject, pixels: int) -> FloatArray | None:
    executed: dict[str, Any] | None = answer["executed_pulses"]
    if executed is not None and executed["simulated_um"]:
        pixel, height_um = executed["pixel"], executed["simulated_um"]
    elif answer["pulses"] is not None:
        pixel, height_um = answer["pulses"]["pixel"], answer["pulses"]["predicted_um"]
    else:
        return None
    heights_um = np.zeros(pixels)
    np.maximum.at(heights_um, np.asarray(pixel, dtype=np.int64), np.asarray(height_um, dtype=np.float64))
    return heights_um


class FrameResult(NamedTuple):
    """What became of a stream's frame: planned, then done, superseded, failed or cancelled; or refused, with the error.

    frame: its number, None where the daemon could not read it; latency: planned_s, first_byte_s, first_light_s
    """

    frame: int | None
    status: str
    plan_id: str | None
    error: OptodriveError | None
    simulated_max_um: float | None
    latency: dict[str, float | None]
    answer: JsonObject

    @classmethod
    def from_message(cls, answer: JsonObject) -> Self:
        """From one answer of the stream."""
        error = answer.get("error")
        if isinstance(error, dict):
            error = build_error(int(error["status"]), error)
        elif error is not None:
            error = RefusedError(f"frame {answer['frame']}: {error}")
        return cls(
            frame=answer["frame"],
            status=answer["status"],
            plan_id=answer.get("plan"),
            error=error,
            simulated_max_um=answer.get("simulated_max_um"),
            latency=answer.get("latency") or {},
            answer=answer,
        )

    @property
    def final(self) -> bool:
        """Whether nothing more comes of this frame."""
        return self.status != "planned"
