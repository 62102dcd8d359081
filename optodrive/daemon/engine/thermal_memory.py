"""Heat and budget in memory that outlives the planner process, so that its successor knows how warm the display is."""

import mmap
import pickle
import struct
import zlib
from typing import NamedTuple

from optodrive.daemon.engine.thermal_estimate import EndedPlan, ThermalEstimate

SLOT_BYTES = 256 * 2**20
"""Room for one state. Memory that was never written costs nothing."""
HEADER = struct.Struct("<QQI")
"""Sequence number, length and CRC-32 of a state; sequence number 0: none."""
SHARE = struct.Struct("<d")


class SavedThermalState(NamedTuple):
    """State at a host time and the board time then, s.

    estimate: after all plans; plans: those that were running, or the first that waited, whose pulses `estimate` counts
    """

    host_s: float
    board_s: float
    estimate: ThermalEstimate
    plans: tuple[EndedPlan, ...]


class ThermalMemory:
    """Two slots that are written in turn, so that a process which ends while it writes leaves the older state.

    The supervisor creates it before it forks the planner. One process at a time uses it.
    """

    def __init__(self) -> None:
        self._map = mmap.mmap(-1, 2 * SLOT_BYTES + SHARE.size)
        self._sequence = 0
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
        data = pickle.dumps(state, pickle.HIGHEST_PROTOCOL)
        if len(data) > SLOT_BYTES - HEADER.size:
            raise ValueError(f"a thermal state of {len(data)} bytes exceeds its room")
        self._sequence += 1
        begin = self._sequence % 2 * SLOT_BYTES
        HEADER.pack_into(self._map, begin, 0, 0, 0)
        self._map[begin + HEADER.size : begin + HEADER.size + len(data)] = data
        HEADER.pack_into(self._map, begin, self._sequence, len(data), zlib.crc32(data))

    def load(self) -> SavedThermalState | None:
        """Return the newest state, None if none was saved, and continue after it."""
        slots = sorted((HEADER.unpack_from(self._map, begin), begin) for begin in (0, SLOT_BYTES))
        for (sequence, length, crc), begin in reversed(slots):
            if not sequence:
                continue
            self._sequence = max(self._sequence, sequence)
            data = self._map[begin + HEADER.size : begin + HEADER.size + length]
            if zlib.crc32(data) == crc:
                state: SavedThermalState = pickle.loads(data)  # noqa: S301 - written by this program's planner
                return state
        return None
