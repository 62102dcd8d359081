"""Requirements of a configuration on a board, as plain numbers: limits to tighten to, capabilities it must have."""

from dataclasses import dataclass

from optodrive.core.errors import InputError, Unquoted
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import RTO_S
from optodrive.link.protocol.quantisation import WireScale

PROTOCOL_MAJOR = 1
BOARDS_OWN = "the limit of the board's firmware"
TICK_HZ = 1_000_000
FRAME_BYTES = 254
MAX_IN_FLIGHT_S = 0.01
"""Maximum transmission time of the bytes in flight. It bounds the delay of an ABORT and the cost of a retransmission.
The protocol permits twice this time."""
BITS_PER_BYTE = 10


@dataclass(frozen=True)
class ConfiguredValues:
    """Values of the configuration that a board may contradict, under their keys, in SI units."""

    pitch_m: float
    bandwidth_hz: float
    slew_rad_per_s: float
    pulse_width_max_s: float
    max_power_w: float
    pulse_energy_max_j: float
    pixel_mean_power_max_w: float


@dataclass(frozen=True)
class BoardRequirements:
    """Requirements of one configuration.

    limits: the limits that the host requests; cell_max_codes: largest cell of its spot guards that no two pixels share
    pixels: number of pixels that its spot guards must tell apart
    lease_s: time for which the board may emit without a renewal by the host
    baud: bit rate of the port, 1/s; uid: the only board that is accepted, hexadecimal, '' for any
    """

    limits: m.Limits
    cell_max_codes: int
    pixels: int
    scale: WireScale
    lease_s: float
    baud: int
    uid: str
    values: ConfiguredValues

    @property
    def max_in_flight_bytes(self) -> int:
        """Maximum number of unacknowledged bytes on the link."""
        return max(2 * FRAME_BYTES, int(self.baud / BITS_PER_BYTE * MAX_IN_FLIGHT_S))

    @property
    def rto_s(self) -> float:
        """Retransmission timeout, s. It exceeds twice the transmission time of the bytes in flight."""
        return RTO_S + 2 * self.max_in_flight_bytes * BITS_PER_BYTE / self.baud

    def check_board(self, peer: m.HelloReply) -> None:
        """Raise InputError with key and value if the board cannot execute plans of this configuration."""
        values = self.values
        if peer.major != PROTOCOL_MAJOR:
            expected = (
                f"{PROTOCOL_MAJOR}.x, of firmware that fits this release; flash it (`optodrive docs --out folder`)"
            )
            raise InputError("board protocol", Unquoted(f"{peer.major}.{peer.minor}"), expected, "board")
        if self.uid and peer.uid.hex() != self.uid.lower():
            expected = f"the board of this uid; the connected one has '{peer.uid.hex()}'"
            raise InputError("board.uid", self.uid, expected, "board")
        if peer.tick_hz != TICK_HZ:
            raise InputError("board tick_hz", peer.tick_hz, f"{TICK_HZ}", "board")
        limits, requested = peer.limits, self.limits
        slower = "a slower servo: the board keeps the gate closed"
        if limits.settle_us > requested.settle_us:
            expected = f"{slower} for {limits.settle_us} µs per move, the plan for {requested.settle_us} µs"
            raise InputError("scanner.bandwidth_hz", values.bandwidth_hz, expected, "board")
        if limits.settle_ns_per_code > requested.settle_ns_per_code:
            expected = (
                f"{slower} for {limits.settle_ns_per_code} ns a code, the plan for {requested.settle_ns_per_code} ns"
            )
            raise InputError("scanner.slew_rad_per_s", values.slew_rad_per_s, expected, "board")
        if limits.max_on_us < requested.max_on_us:
            max_s = limits.max_on_us * 1e-6
            raise InputError(
                "limits.pulse_width_max_s",
                values.pulse_width_max_s,
                f"at most {max_s:g}, {BOARDS_OWN} (max_on_us)",
                "board",
            )
        if abs(limits.full_power_uw - requested.full_power_uw) > 0.01 * requested.full_power_uw:
            # Neither number is known to be true: to follow the lower one would count less light than the diode emits.
            expected = (
                f"the firmware's full power, now {limits.full_power_uw * 1e-6:g} W (full_power_uw in its settings.h). "
                "Both state the power at the sample at full duty: measure it there with a power meter, the board off, "
                "the driver's input at full level, then set both to what is measured, and neither lower"
            )
            raise InputError("laser.max_power_w", values.max_power_w, expected, "board")
        if limits.spot_uj < values.pulse_energy_max_j * 1e6:
            max_j = limits.spot_uj * 1e-6
            raise InputError(
                "limits.pulse_energy_max_j",
                values.pulse_energy_max_j,
                f"at most {max_j:g}, {BOARDS_OWN} (spot_uj)",
                "board",
            )
        if limits.spot_leak_uw < values.pixel_mean_power_max_w * 1e6:
            max_w = limits.spot_leak_uw * 1e-6
            key = "limits.pixel_mean_power_max_w"
            raise InputError(
                key, values.pixel_mean_power_max_w, f"at most {max_w:g}, {BOARDS_OWN} (spot_leak_uw)", "board"
            )
        if peer.cell_codes > self.cell_max_codes:
            distance = f"{self.cell_max_codes}, the distance of neighbouring pixels"
            expected = f"a board whose cell_codes are at most {distance}; this one's are {peer.cell_codes}"
            raise InputError("display.pitch_m", values.pitch_m, expected, "board")
        if peer.cells < self.pixels:
            expected = f"at most {peer.cells}, the spots that this board can guard"
            raise InputError("display pixels", self.pixels, expected, "board")
        for axis in ("x", "y"):
            low, high = getattr(limits, f"{axis}_min"), getattr(limits, f"{axis}_max")
            if getattr(requested, f"{axis}_min") < low or getattr(requested, f"{axis}_max") > high:
                expected = f"codes within {low} to {high}, {BOARDS_OWN} ({axis}_min, {axis}_max)"
                stated = f"{getattr(requested, f'{axis}_min')} to {getattr(requested, f'{axis}_max')}"
                raise InputError(f"display {axis}", Unquoted(stated), expected, "board")
