"""Proven frames to a Helios, one after the other, each when the board is ready for it; dark whatever ends it."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from optodrive.core.clock import Clock
from optodrive.core.errors import LinkError
from optodrive.link.helios.dac import Helios
from optodrive.link.helios.frames import HeliosFrame
from optodrive.link.helios.verification import VerifiedFrames

POLL_INTERVAL_S = 0.001
READY_TIMEOUT_S = 0.5
"""A board that is not ready for so long, with frames of a twentieth of that, is not well."""

ProgressCallback = Callable[[float], None]


@dataclass(frozen=True)
class PlaybackReport:
    """What was sent. holes: how often the board had nothing to play between two frames; hole_s: for how long at least.

    In a hole it is dark, and all that follows comes so much later.
    """

    frames: int
    underruns: int
    underrun_s: float


def play(
    helios: Helios, verified: VerifiedFrames, clock: Clock, on_progress: ProgressCallback = lambda _share: None
) -> PlaybackReport:
    """Play frames on a display that is as cool as the plan takes it to be; blocks until the light has ended.

    tick: told the share sent, often, also while the board is not ready; what it raises ends the light. Raises
    InputError without an interlock, LinkError where the board fails; whatever it is, the board is stopped first.
    """
    helios.require_interlock()
    try:
        helios.stop()  # and with that its mirrors in the middle, where every plan begins
        helios.open_shutter()
        report = _send_frames(helios, verified.frames, clock, on_progress)
    except BaseException:
        with suppress(LinkError):  # what went wrong first is told; leaving the board tries once more
            helios.stop()
        raise
    helios.stop()
    return report


def _send_frames(
    helios: Helios, frames: tuple[HeliosFrame, ...], clock: Clock, on_progress: ProgressCallback
) -> PlaybackReport:
    underruns, underrun_s, end_s = 0, 0.0, clock.now_s()
    for number, frame in enumerate(frames):
        share = number / len(frames)
        _wait_until_ready(helios, clock, lambda share=share: on_progress(share))  # type: ignore[misc]
        helios.send(frame)
        now_s = clock.now_s()
        if number and now_s > end_s:
            underruns, underrun_s = underruns + 1, underrun_s + now_s - end_s
        end_s = max(end_s, now_s) + frame.duration_s
    while clock.now_s() < end_s:
        on_progress(1.0)
        clock.sleep(POLL_INTERVAL_S)
    return PlaybackReport(len(frames), underruns, underrun_s)


def _wait_until_ready(helios: Helios, clock: Clock, on_progress: Callable[[], None]) -> None:
    deadline_s = clock.now_s() + READY_TIMEOUT_S
    on_progress()
    while not helios.is_ready():
        if clock.now_s() > deadline_s:
            raise LinkError(f"the Helios was not ready for a frame within {READY_TIMEOUT_S:g} s; it was stopped")
        on_progress()
        clock.sleep(POLL_INTERVAL_S)
