"""Heat and budget in memory that outlives the planner process, so that its successor knows how warm the display is."""

import mmap
import pickle
import struct
from typing import NamedTuple
from uuid import uuid4

from optodrive.daemon.engine.thermal_estimate import EndedPlans, ThermalEstimate

SLOT_BYTES = 256 * 2**20
"""Room for one state. Memory that was never written costs nothing."""
HEADER = struct.Struct("<QQ")
"""Sequence number and length of a state; sequence number 0: none."""
LENGTH = struct.Struct("<Q")
SHARE = struct.Struct("<d")


class SavedThermalState(NamedTuple):
    """State at a host time and the board time then, s.

    estimate: after all plans; ended: those that were running, or the first that waited, whose pulses `estimate` counts
    """

    host_s: float
    board_s: float
    estimate: ThermalEstimate
    ended: EndedPlans | None


class ThermalMemory:
    """Two slots that are written in turn, so that a process which ends while it writes leaves the older state.

    A slot gets its number once it is whole. No checksum is needed: the stores of a process that was killed are those of
    its instructions up to there. The supervisor creates it before it forks the planner. One process at a time uses it.
    owner: mark of the daemon, the same for all its planners
    """

    def __init__(self) -> None:
        self._map = mmap.mmap(-1, 2 * SLOT_BYTES + SHARE.size)
        self._sequence = 0
        self.owner = uuid4().hex
        self.power_share = 1.0

    @property
    def power_share(self) -> float:
        """Largest power of a pulse as a share of the laser's, as it was set last."""
        share: float = SHARE.unpack_from(self._map, 2 * SLOT_BYTES)[0]
        return share

    @power_share.setter
    def power_share(self, share: float) -> None:
        SHARE.pack_into(self._map, 2 * SLOT_BYTES, share)

    def save(self, state: SavedThermalState) -> None:
        """Save a state. Raise ValueError if it exceeds its room."""
        arrays: list[pickle.PickleBuffer] = []
        frame = pickle.dumps(state, pickle.HIGHEST_PROTOCOL, buffer_callback=arrays.append)
        parts = [memoryview(frame), *(array.raw() for array in arrays)]  # the arrays are copied once, to their place
        total_bytes = sum(LENGTH.size + part.nbytes for part in parts)
        if total_bytes > SLOT_BYTES - HEADER.size:
            raise ValueError(f"a thermal state of {total_bytes} bytes exceeds its room")
        self._sequence += 1
        begin = self._sequence % 2 * SLOT_BYTES
        position = begin + HEADER.size
        for part in parts:
            LENGTH.pack_into(self._map, position, part.nbytes)
            position += LENGTH.size
            self._map[position : position + part.nbytes] = part
            position += part.nbytes
        HEADER.pack_into(self._map, begin, self._sequence, total_bytes)

    def load(self) -> SavedThermalState | None:
        """Return the newest state, None if none was saved, and continue after it."""
        slots = [(HEADER.unpack_from(self._map, begin), begin) for begin in (0, SLOT_BYTES)]
        (sequence, length), begin = max(slots)
        if not sequence:
            return None
        self._sequence = sequence
        parts = self._read_parts(begin + HEADER.size, length)
        state: SavedThermalState = pickle.loads(parts[0], buffers=parts[1:])  # noqa: S301 - this program wrote it
        return state

    def _read_parts(self, begin: int, length: int) -> list[bytearray]:
        """Return copies of the parts of a state, the pickled frame first."""
        parts, position = [], begin
        while position < begin + length:
            (part_bytes,) = LENGTH.unpack_from(self._map, position)
            position += LENGTH.size
            parts.append(bytearray(self._map[position : position + part_bytes]))
            position += part_bytes
        return parts
