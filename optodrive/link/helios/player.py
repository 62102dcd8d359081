"""Proven frames to a Helios, one after the other, each when the board is ready for it; dark whatever ends it."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from optodrive.core.clock import Clock
from optodrive.core.errors import LinkError
from optodrive.link.helios.dac import Helios
from optodrive.link.helios.frames import HeliosFrame
from optodrive.link.helios.verification import ProvenFrames

POLL_S = 0.001
PATIENCE_S = 0.5
"""A board that is not ready for so long, with frames of a twentieth of that, is not well."""

Tick = Callable[[float], None]


@dataclass(frozen=True)
class Played:
    """What was sent. holes: how often the board had nothing to play between two frames; hole_s: for how long at least.

    In a hole it is dark, and all that follows comes so much later.
    """

    frames: int
    holes: int
    hole_s: float


def play(helios: Helios, proven: ProvenFrames, clock: Clock, tick: Tick = lambda _share: None) -> Played:
    """Play frames on a display that is as cool as the plan takes it to be; blocks until the light has ended.

    tick: told the share sent, often, also while the board is not ready; what it raises ends the light. Raises
    InputError without an interlock, LinkError where the board fails; whatever it is, the board is stopped first.
    """
    helios.require_interlock()
    try:
        helios.dark()  # and with that its mirrors in the middle, where every plan begins
        helios.open_shutter()
        played = _stream(helios, proven.frames, clock, tick)
    except BaseException:
        with suppress(LinkError):  # what went wrong first is told; leaving the board tries once more
            helios.dark()
        raise
    helios.dark()
    return played


def _stream(helios: Helios, frames: tuple[HeliosFrame, ...], clock: Clock, tick: Tick) -> Played:
    holes, hole_s, ends_s = 0, 0.0, clock.now_s()
    for number, frame in enumerate(frames):
        share = number / len(frames)
        _wait_until_ready(helios, clock, lambda share=share: tick(share))  # type: ignore[misc]
        helios.send(frame)
        now_s = clock.now_s()
        if number and now_s > ends_s:
            holes, hole_s = holes + 1, hole_s + now_s - ends_s
        ends_s = max(ends_s, now_s) + frame.duration_s
    while clock.now_s() < ends_s:
        tick(1.0)
        clock.sleep(POLL_S)
    return Played(len(frames), holes, hole_s)


def _wait_until_ready(helios: Helios, clock: Clock, tick: Callable[[], None]) -> None:
    give_up_s = clock.now_s() + PATIENCE_S
    tick()
    while not helios.ready():
        if clock.now_s() > give_up_s:
            raise LinkError(f"the Helios was not ready for a frame within {PATIENCE_S:g} s; it was stopped")
        tick()
        clock.sleep(POLL_S)
