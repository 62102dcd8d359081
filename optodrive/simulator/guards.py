"""What the board watches before it opens the gate: on time, mean power, energy per cell (B4 to B6). Integers only."""

from collections import deque

from optodrive.wire.messages import Limits

WINDOW_US = 1_000_000
DUTY_FULL = 65535


class Guards:
    """The accounts of one board; times in µs."""

    def __init__(self, cell_codes: int) -> None:
        self._cell_codes = cell_codes
        self._on: dict[tuple[int, int], tuple[int, int]] = {}
        self._bucket: dict[tuple[int, int], tuple[int, int]] = {}
        self._recent: deque[tuple[int, int, int]] = deque()

    def cell(self, x: int, y: int) -> tuple[int, int]:
        """The cell of a position; the field's centre is the centre of a cell."""
        half = self._cell_codes // 2
        return (x - 32768 + half) // self._cell_codes, (y - 32768 + half) // self._cell_codes

    def refuses(self, limits: Limits, x: int, y: int, start_us: int, on_us: int, duty: int) -> str:
        """The fault that this pulse would be, '' where it may fire."""
        cell = self.cell(x, y)
        if self.on_time_us(limits, cell, start_us) + on_us > limits.max_on_us:
            return "ON_TIME"
        if self.mean_account(start_us, on_us, duty) > WINDOW_US * limits.mean_duty:
            return "MEAN_POWER"
        if self.bucket_uj(limits, cell, start_us) + energy_uj(limits, on_us, duty) > limits.spot_uj:
            return "SPOT"
        return ""

    def fire(self, limits: Limits, x: int, y: int, start_us: int, on_us: int, duty: int) -> None:
        """Count a pulse."""
        cell = self.cell(x, y)
        self._on[cell] = self.on_time_us(limits, cell, start_us) + on_us, start_us + on_us
        self._bucket[cell] = self.bucket_uj(limits, cell, start_us) + energy_uj(limits, on_us, duty), start_us
        self._recent.append((start_us, on_us, duty))

    def on_time_us(self, limits: Limits, cell: tuple[int, int], at_us: int) -> int:
        """Light a cell had without a rest up to at_us."""
        on_us, ended_us = self._on.get(cell, (0, -WINDOW_US))
        return 0 if at_us - ended_us >= limits.rest_us else on_us

    def bucket_uj(self, limits: Limits, cell: tuple[int, int], at_us: int) -> int:
        """Level of a cell's leaky bucket."""
        level_uj, since_us = self._bucket.get(cell, (0, 0))
        return max(0, level_uj - (at_us - since_us) * limits.spot_leak_uw // 1_000_000)

    def mean_account(self, start_us: int, on_us: int, duty: int) -> int:
        """Most gate-on time × duty that any second would hold with this pulse, µs × duty code."""
        while self._recent and sum(self._recent[0][:2]) <= start_us - WINDOW_US:
            self._recent.popleft()
        # The sum of a second grows until the pulse ends, or a brighter old pulse begins to leave the second.
        ends = [start_us + on_us]
        for begun_us, _, _ in self._recent:
            if begun_us + WINDOW_US >= start_us + on_us:
                break
            if begun_us + WINDOW_US > start_us:
                ends.append(begun_us + WINDOW_US)
        return max(self._second_before(end_us) + (end_us - start_us) * duty for end_us in ends)

    def _second_before(self, end_us: int) -> int:
        begin_us = end_us - WINDOW_US
        return sum(max(0, start + on - max(start, begin_us)) * duty for start, on, duty in self._recent)


def energy_uj(limits: Limits, on_us: int, duty: int) -> int:
    """Energy of a pulse, µJ, rounded up."""
    return -(-on_us * duty * limits.full_power_uw // (DUTY_FULL * 1_000_000))
