"""Playback of verified chunks on a laser DAC. The DAC is stopped however playback ends."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from optodrive.core.clock import Clock
from optodrive.core.errors import LinkError
from optodrive.link.dac.formats.base import Chunk
from optodrive.link.dac.laser_dac import LaserDac
from optodrive.link.dac.verification import VerifiedChunks

POLL_INTERVAL_S = 0.001
READY_TIMEOUT_S = 0.5
"""Maximum time for the DAC to become ready, 20 times the longest chunk."""


@dataclass(frozen=True)
class PlaybackReport:
    """Report of a playback.

    underruns, underrun_s: number and minimum total duration of gaps between chunks; nothing is emitted in a gap, and
    everything after it is late
    """

    chunks: int
    underruns: int
    underrun_s: float


def play(
    dac: LaserDac,
    verified: VerifiedChunks,
    clock: Clock,
    on_progress: Callable[[float], None] = lambda _fraction: None,
) -> PlaybackReport:
    """Play chunks on a display in the thermal state that the plan assumes. Block until emission has ended.

    on_progress: called often with the sent fraction; an exception that it raises ends the playback
    Raise InputError without an interlock and LinkError if the DAC fails. The DAC is stopped before any exception
    propagates.
    """
    dac.require_interlock()
    try:
        dac.stop()  # also centres the mirrors, where every plan starts
        dac.start()
        report = _send_chunks(dac, verified.chunks, clock, on_progress)
    except BaseException:
        with suppress(LinkError):  # the first error propagates; closing the DAC stops it again
            dac.stop()
        raise
    dac.stop()
    return report


def _send_chunks(
    dac: LaserDac, chunks: tuple[Chunk, ...], clock: Clock, on_progress: Callable[[float], None]
) -> PlaybackReport:
    underruns, underrun_s, end_s = 0, 0.0, clock.now_s()
    for number, chunk in enumerate(chunks):
        fraction = number / len(chunks)
        _wait_until_ready(dac, clock, lambda fraction=fraction: on_progress(fraction))  # type: ignore[misc]
        dac.send(chunk)
        now_s = clock.now_s()
        if number and now_s > end_s:
            underruns, underrun_s = underruns + 1, underrun_s + now_s - end_s
        end_s = max(end_s, now_s) + chunk.duration_s
    while clock.now_s() < end_s + dac.format.lag_max_s:
        on_progress(1.0)
        clock.sleep(POLL_INTERVAL_S)
    return PlaybackReport(len(chunks), underruns, underrun_s)


def _wait_until_ready(dac: LaserDac, clock: Clock, on_progress: Callable[[], None]) -> None:
    deadline_s = clock.now_s() + READY_TIMEOUT_S
    on_progress()
    while not dac.is_ready():
        if clock.now_s() > deadline_s:
            raise LinkError(
                f"the {dac.format.label} was not ready for a chunk within {READY_TIMEOUT_S:g} s; it was stopped"
            )
        on_progress()
        clock.sleep(POLL_INTERVAL_S)
