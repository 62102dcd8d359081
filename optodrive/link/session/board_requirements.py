"""Requirements of a configuration on a board: the limits it must tighten to and the capabilities it must have."""

from dataclasses import dataclass
from math import ceil

import numpy as np

from optodrive.core.errors import InputError
from optodrive.device.config import Config
from optodrive.device.field_loader import build_settling_table, load_scan_field
from optodrive.device.pixel_map import build_aim_layout
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import RTO_S
from optodrive.link.protocol.quantisation import CENTRE_CODE, CODE_MAX, WireScale

PROTOCOL_MAJOR = 1
TICK_HZ = 1_000_000
CAP_MARGIN = 1.05
"""Ratio of the board's caps to the limiter's. The board is the second line of defence behind the limiter."""
FIELD_MARGIN_CODES = 64
FRAME_BYTES = 254
MAX_IN_FLIGHT_S = 0.01
"""Maximum transmission time of the bytes in flight. It bounds the delay of an ABORT and the cost of a retransmission.
The protocol permits twice this time."""
BITS_PER_BYTE = 10


@dataclass(frozen=True)
class BoardRequirements:
    """Requirements of one configuration.

    margin_codes: DAC codes by which the permitted range extends beyond the outermost pixels
    """

    config: Config
    scale: WireScale
    margin_codes: int = FIELD_MARGIN_CODES

    @classmethod
    def from_config(cls, config: Config, margin_codes: int = FIELD_MARGIN_CODES) -> "BoardRequirements":
        """Derive the requirements. The DAC codes span the whole range of the scanner."""
        scale = WireScale(
            rad_per_code=config.scanner.range_rad / (CODE_MAX - CENTRE_CODE),
            full_power_w=config.laser.max_power_w,
            tick_s=1.0 / TICK_HZ,
        )
        return cls(config, scale, margin_codes)

    @property
    def lease_s(self) -> float:
        """Time for which the board may emit without a renewal by the host, s."""
        return self.config.board.lease_s

    @property
    def max_in_flight_bytes(self) -> int:
        """Maximum number of unacknowledged bytes on the link."""
        return max(2 * FRAME_BYTES, int(self.config.board.baud / BITS_PER_BYTE * MAX_IN_FLIGHT_S))

    @property
    def rto_s(self) -> float:
        """Retransmission timeout, s. It exceeds twice the transmission time of the bytes in flight."""
        return RTO_S + 2 * self.max_in_flight_bytes * BITS_PER_BYTE / self.config.board.baud

    def build_limits(self) -> m.Limits:
        """Return the limits that the host requests."""
        limits, layout = self.config.limits, build_aim_layout(self.config)
        settle_us, settle_ns_per_code = self._compute_settling()
        angles_rad = load_scan_field(self.config).angles_rad(layout.x_m, layout.y_m)
        x_codes, y_codes = (self.scale.to_codes(angle_rad) for angle_rad in angles_rad)
        return m.Limits(
            max_on_us=ceil(limits.pulse_width_max_s * 1e6),
            max_duty=65535,
            mean_duty=65535,
            spot_uj=ceil(limits.pulse_energy_max_j * 1e6 * CAP_MARGIN),
            spot_leak_uw=ceil(limits.pixel_mean_power_max_w * 1e6 * CAP_MARGIN),
            full_power_uw=round(self.config.laser.max_power_w * 1e6),
            x_min=max(0, int(x_codes.min()) - self.margin_codes),
            x_max=min(CODE_MAX, int(x_codes.max()) + self.margin_codes),
            y_min=max(0, int(y_codes.min()) - self.margin_codes),
            y_max=min(CODE_MAX, int(y_codes.max()) + self.margin_codes),
            settle_us=settle_us,
            settle_ns_per_code=settle_ns_per_code,
            rest_us=round(limits.pulse_gap_min_s * 1e6),
            lease_ms=round(self.lease_s * 1e3),
        )

    def _compute_settling(self) -> tuple[int, int]:
        """Return settle_us and settle_ns_per_code, a line that nowhere exceeds the planned settling time.

        Its slope is the slew rate. The planned time jumps where longer moves start to overshoot, so a steeper line
        would have to start lower for short moves.
        """
        settling_table = build_settling_table(self.config)
        ns_per_code = int(self.scale.rad_per_code / self.config.scanner.slew_rad_per_s * 1e9)
        pitches = np.arange(1, len(settling_table.after_long_dwell[0]))
        # Quantisation may lengthen a move by one code.
        codes = np.floor(pitches * settling_table.pitch_rad / self.scale.rad_per_code).astype(np.int64) + 2
        times_us = np.minimum(*(np.array(table)[pitches] for table in settling_table.after_long_dwell))
        return int((times_us + -codes * ns_per_code // 1000).min()), ns_per_code

    def check_board(self, peer: m.HelloReply) -> None:
        """Raise InputError with key and value if the board cannot execute plans of this configuration."""
        config = self.config
        if peer.major != PROTOCOL_MAJOR:
            raise InputError("board protocol", f"{peer.major}.{peer.minor}", f"major version {PROTOCOL_MAJOR}", "board")
        if config.board.uid and peer.uid.hex() != config.board.uid.lower():
            raise InputError("board.uid", peer.uid.hex(), f"{config.board.uid}, the configured board", "board")
        if peer.tick_hz != TICK_HZ:
            raise InputError("board tick_hz", peer.tick_hz, f"{TICK_HZ}", "board")
        limits, requested = peer.limits, self.build_limits()
        slower = "a slower servo: the board keeps the gate closed"
        if limits.settle_us > requested.settle_us:
            expected = f"{slower} for {limits.settle_us} µs per move, the plan for {requested.settle_us} µs"
            raise InputError("scanner.bandwidth_hz", config.scanner.bandwidth_hz, expected, "board")
        if limits.settle_ns_per_code > requested.settle_ns_per_code:
            expected = (
                f"{slower} for {limits.settle_ns_per_code} ns a code, the plan for {requested.settle_ns_per_code} ns"
            )
            raise InputError("scanner.slew_rad_per_s", config.scanner.slew_rad_per_s, expected, "board")
        if limits.max_on_us < requested.max_on_us:
            max_s = limits.max_on_us * 1e-6
            raise InputError("limits.pulse_width_max_s", config.limits.pulse_width_max_s, f"at most {max_s:g}", "board")
        if abs(limits.full_power_uw - requested.full_power_uw) > 0.01 * requested.full_power_uw:
            board_w = limits.full_power_uw * 1e-6
            raise InputError(
                "laser.max_power_w", config.laser.max_power_w, f"{board_w:g}, the setting of the board", "board"
            )
        if limits.spot_uj < config.limits.pulse_energy_max_j * 1e6:
            max_j = limits.spot_uj * 1e-6
            raise InputError(
                "limits.pulse_energy_max_j", config.limits.pulse_energy_max_j, f"at most {max_j:g}", "board"
            )
        if limits.spot_leak_uw < config.limits.pixel_mean_power_max_w * 1e6:
            max_w = limits.spot_leak_uw * 1e-6
            key = "limits.pixel_mean_power_max_w"
            raise InputError(key, config.limits.pixel_mean_power_max_w, f"at most {max_w:g}", "board")
        for axis in ("x", "y"):
            low, high = getattr(limits, f"{axis}_min"), getattr(limits, f"{axis}_max")
            if getattr(requested, f"{axis}_min") < low or getattr(requested, f"{axis}_max") > high:
                raise InputError(
                    f"display {axis}", "the lattice", f"to lie within the board's codes {low} to {high}", "board"
                )
