"""Playback of verified frames on a Helios. The DAC is stopped however playback ends."""

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
"""Maximum time for the DAC to become ready, 20 times the longest frame."""


@dataclass(frozen=True)
class PlaybackReport:
    """Report of a playback.

    underruns, underrun_s: number and minimum total duration of gaps between frames; nothing is emitted in a gap, and
    everything after it is late
    """

    frames: int
    underruns: int
    underrun_s: float


def play(
    helios: Helios,
    verified: VerifiedFrames,
    clock: Clock,
    on_progress: Callable[[float], None] = lambda _fraction: None,
) -> PlaybackReport:
    """Play frames on a display in the thermal state that the plan assumes. Block until emission has ended.

    on_progress: called often with the sent fraction; an exception that it raises ends the playback
    Raise InputError without an interlock and LinkError if the DAC fails. The DAC is stopped before any exception
    propagates.
    """
    helios.require_interlock()
    try:
        helios.stop()  # also centres the mirrors, where every plan starts
        helios.open_shutter()
        report = _send_frames(helios, verified.frames, clock, on_progress)
    except BaseException:
        with suppress(LinkError):  # the first error propagates; closing the DAC stops it again
            helios.stop()
        raise
    helios.stop()
    return report


def _send_frames(
    helios: Helios, frames: tuple[HeliosFrame, ...], clock: Clock, on_progress: Callable[[float], None]
) -> PlaybackReport:
    underruns, underrun_s, end_s = 0, 0.0, clock.now_s()
    for number, frame in enumerate(frames):
        fraction = number / len(frames)
        _wait_until_ready(helios, clock, lambda fraction=fraction: on_progress(fraction))  # type: ignore[misc]
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
