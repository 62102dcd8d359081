"""A push on its way through the daemon's processes."""

from typing import NamedTuple

from optodrive.core.types.push_options import PushOptions


class Push(NamedTuple):
    """The fields of a push besides its body. A message carries the mapping `_asdict()`.

    name: what the plan is called
    streamed: replace everything not yet sent; the next streamed plan replaces this one in the same way
    standing: draw the part of a streamed page whose turn it is
    refreshes: whether the page stands already, and nobody waits for the plan's report or its end
    arrived_s: monotonic time of its arrival; epoch: in which it arrived; caller: name of its token
    lists_pulses: whether the answer lists the pulses one by one
    """

    name: str
    options: PushOptions
    arrived_s: float
    epoch: int
    caller: str = ""
    streamed: bool = False
    lists_pulses: bool = True
    standing: bool = False
    refreshes: bool = False
