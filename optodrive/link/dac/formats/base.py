"""Properties that a laser DAC states: grid of time, resolution, buffer and bytes.

Theory of operation. A laser DAC plays points: two mirror codes and a level, each for one period of its clock. It has no
arming, no lease and no report, so all safety lies in what it is given and when. Three properties carry it:

- Points are cut into chunks of at most 25 ms that are played once and end dark. A device that runs empty therefore ends
  on a dark point, whether it then blanks its outputs or holds the last one until a time-out of its own.
- At most one chunk waits behind the one that plays. A dead host leaves that much light, `host_loss_max_s`.
- A device may play slower than it is asked to, `stretch`. Levels are lower by that factor, so that a pulse
  never has more energy than planned, however long it lasts.

A device driver adds nothing to this but bytes, flow control and a stop. Encoder, proof and player do not know it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from optodrive.core.errors import LocalProtocolError
from optodrive.core.types.arrays import IntArray

CHUNK_MAX_S = 0.025
CLOCK_ERROR = 2e-4
"""Largest relative difference of two crystals."""

PointTable = IntArray
"""Points [n, 3]: code of mirror x, code of mirror y, level. Codes have 12 bits."""


@dataclass(frozen=True, eq=False)
class Chunk:
    """Chunk of points that is safe to send. DacFormat.check() builds it.

    data: its bytes on the wire
    points: number of points
    duration_s: nominal playing time
    """

    data: bytes
    points: int
    duration_s: float


class DacFormat(ABC):
    """Properties of one kind of laser DAC at a requested rate, and the bytes of its chunks.

    points_per_s: requested rate
    label: its name in messages
    level_max: number of steps of power
    clock_hz: clock that a point lasts whole ticks of
    points_max: maximum number of points of a chunk
    host_loss_max_s: maximum emission after the last byte of a dead host
    lag_max_s: maximum time by which playback ends later than the host expects
    stops_at_once: whether its stop ends what it has received, or only what follows
    fixed_length: every chunk of a plan has the same number of points
    settling_points: dark points that precede a pulse in addition to the planned dark time
    """

    label: ClassVar[str]
    level_max: ClassVar[int]
    clock_hz: ClassVar[int]
    points_max: ClassVar[int]
    host_loss_max_s: ClassVar[float]
    lag_max_s: ClassVar[float] = 0.0
    stops_at_once: ClassVar[bool] = True
    fixed_length: ClassVar[bool] = False
    settling_points: ClassVar[int] = 0

    def __init__(self, points_per_s: int) -> None:
        self.points_per_s = points_per_s

    @property
    @abstractmethod
    def point_ticks(self) -> int:
        """Duration of a point in clock ticks."""

    @property
    def slowest_point_s(self) -> float:
        """Longest duration of a point by this computer's clock, of a device that keeps the rate, s."""
        return self.point_ticks / self.clock_hz * (1.0 + CLOCK_ERROR)

    @property
    def stretch(self) -> float:
        """Factor by which a point may last longer than its ticks."""
        return 1.0

    def accepts_length(self, points: int) -> bool:
        """Return whether the device can take a chunk of this length."""
        return True

    @abstractmethod
    def pack(self, points: PointTable, begin_ticks: int) -> bytes:
        """Return the bytes of points [n, 3] that begin at a tick of the plan."""

    @abstractmethod
    def parse(self, data: bytes) -> tuple[PointTable, int]:
        """Return the points of a chunk as the device reads them, and the ticks of each.

        The strongest channel is the level. Raise LocalProtocolError if the bytes contradict themselves.
        """

    def check(self, data: bytes) -> Chunk:
        """Return the chunk with these bytes. Raise LocalProtocolError if it could leave the laser on or stall it."""
        points, ticks = self.parse(data)
        duration_s = len(points) * ticks / self.clock_hz
        if points[-1, 2]:
            raise LocalProtocolError("a chunk whose last point is not blank")
        if duration_s > CHUNK_MAX_S:
            raise LocalProtocolError(f"a chunk of {duration_s:.4f} s, the maximum is {CHUNK_MAX_S:g} s")
        if len(points) > self.points_max:
            raise LocalProtocolError(f"a chunk of {len(points)} points, the {self.label} takes {self.points_max}")
        if not self.accepts_length(len(points)):
            raise LocalProtocolError(f"a chunk of {len(points)} points, on which the {self.label} stalls")
        return Chunk(data, len(points), duration_s)
