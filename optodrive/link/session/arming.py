"""Requirements of a configuration on a board, its arming, and the lease that keeps it armed.

Requirements are plain numbers: limits to tighten to, and capabilities that the board must have. An arming is requested
once, followed by the board's reports, and lost when they contradict it. Renewals of the lease have a schedule and
statistics.
"""

import secrets
from dataclasses import dataclass

from optodrive.core.errors import InputError, Unquoted
from optodrive.core.histogram import Histogram
from optodrive.link.protocol import messages as m
from optodrive.link.protocol.connection import RTO_S
from optodrive.link.protocol.quantisation import WireScale
from optodrive.link.protocol.states import BoardState

_PROGRESS: dict[str, int] = {BoardState.ARMING: 1, BoardState.ARMED: 2, BoardState.RUNNING: 2, BoardState.HOLD: 2}
"""How far the board is in each state; 0 in all others."""


class Arming:
    """The arming that a session has requested. Only while it is present may the board have a lease or points.

    is_present: from the request until end(), or until the board reports that it has left what it had reached
    is_lost: whether the board's reports have ended it, since the last request
    """

    def __init__(self) -> None:
        self.is_present = self.is_lost = False
        self._progress = 0
        self._nonce: int | None = None

    def begin(self) -> m.ArmReq:
        """Begin an arming and return its request."""
        self.is_present, self.is_lost = True, False
        self._progress, self._nonce = 0, secrets.randbits(32)
        return m.ArmReq(host_nonce=self._nonce)

    def end(self) -> None:
        """End the arming. Only begin() brings another."""
        self.is_present = self.is_lost = False
        self._nonce = None

    def confirm(self, challenge: m.ArmChallenge) -> m.ArmConfirm | None:
        """Return the confirmation of the board's challenge, None if it does not answer this arming's request."""
        # A challenge that answers an earlier request may still be on the line; confirmed, it would arm for nobody.
        if self._nonce is None or challenge.host_nonce != self._nonce:
            return None
        self._nonce = None
        return m.ArmConfirm(host_nonce=challenge.host_nonce, board_nonce=challenge.board_nonce)

    def follow(self, state: str) -> None:
        """Take over a state that the board has reported."""
        if not self.is_present:
            return
        progress = _PROGRESS.get(state, 0)
        # Backwards only: ARMED and RUNNING alternate within one arming, and reports of both may cross.
        if progress < self._progress:
            self.end()
            self.is_lost = True
        self._progress = progress


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
    full_power_w: float
    pulse_energy_max_j: float
    pixel_mean_power_max_w: float
    modulation: str
    whole_periods: bool


@dataclass(frozen=True)
class BoardRequirements:
    """Requirements of one configuration.

    limits: the limits that the host requests; cell_max_codes: largest cell of its spot guards that no two pixels share
    pixels: number of pixels that its spot guards must tell apart
    lease_s: time for which the board may emit without a renewal by the host
    baud: bit rate of the port, 1/s; uid: the only board that is accepted, hexadecimal, '' for any
    interface: by which the board moves the mirrors, of the configuration; feedback: whether it must measure them
    """

    limits: m.Limits
    cell_max_codes: int
    pixels: int
    scale: WireScale
    lease_s: float
    baud: int
    uid: str
    interface: str
    feedback: bool
    values: ConfiguredValues

    @property
    def feedback_codes(self) -> int:
        """Codes that a measured mirror may be away from its command, 0 if none is measured."""
        return self.cell_max_codes // 2 if self.feedback else 0

    @property
    def max_in_flight_bytes(self) -> int:
        """Maximum number of unacknowledged bytes on the link."""
        # At least two frames, or a slow line would wait for each acknowledgement.
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
        interface = "xy2-100" if peer.capabilities & m.CAPABILITY_XY2_100 else "analog"
        if interface != self.interface:
            expected = f"{interface}, as this board's firmware has it (by `optodrive board build`)"
            raise InputError("scanner.interface", self.interface, expected, "board")
        if not peer.capabilities & m.CAPABILITY_EXACT_WIDTHS:
            own = "this board's firmware does not keep pulses to the microsecond (by `optodrive board build`)"
            if values.modulation == "on_off":
                raise InputError("laser.modulation", values.modulation, f"'pwm': {own}", "board")
            if not values.whole_periods:
                raise InputError("laser.whole_periods", values.whole_periods, f"True: {own}", "board")
        if self.feedback and not peer.capabilities & m.CAPABILITY_FEEDBACK:
            expected = "false, as this board does not measure the mirrors (by `optodrive board build`)"
            raise InputError("scanner.feedback", "true", expected, "board")
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
                f"the firmware's full power, now {limits.full_power_uw * 1e-6:g} W (by `optodrive board build`). "
                "Both state the power at the sample at full duty, of a laser.curve the largest ratio of power to duty: "
                "measure it there with a power meter, the board off, the driver's input at full level, then set both "
                "to what is measured, and neither lower"
            )
            raise InputError("laser.max_power_w", values.full_power_w, expected, "board")
        # Compared with the configured value, not with the requested one, which is 5 % larger (`CAP_MARGIN`): that much
        # the board may lack.
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
        # Else a frame within all caps ends in fault CELLS, when the table is full.
        if peer.cells < self.pixels:
            expected = f"at most {peer.cells}, the spots that this board can guard"
            raise InputError("display pixels", self.pixels, expected, "board")
        for axis in ("x", "y"):
            low, high = getattr(limits, f"{axis}_min"), getattr(limits, f"{axis}_max")
            if getattr(requested, f"{axis}_min") < low or getattr(requested, f"{axis}_max") > high:
                expected = f"codes within {low} to {high}, {BOARDS_OWN} ({axis}_min, {axis}_max)"
                stated = f"{getattr(requested, f'{axis}_min')} to {getattr(requested, f'{axis}_max')}"
                raise InputError(f"display {axis}", Unquoted(stated), expected, "board")


RENEWAL_FRACTION = 0.2
"""Interval between renewals as a fraction of the lease."""
AGE_BUCKETS_S = (0.01, 0.02, 0.025, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.2, 0.5, 1.0)


class LeaseRenewal:
    """Schedule of the renewals of one lease.

    ages: distribution of the time between renewals, s
    slack_s: minimum remaining lease at a renewal, None before the second renewal
    """

    def __init__(self, lease_s: float) -> None:
        self.ages = Histogram(AGE_BUCKETS_S)
        self.slack_s: float | None = None
        self._lease_s = lease_s
        self._sent_s = 0.0
        self._active = False

    def pause(self) -> None:
        """Stop the statistics while the board needs no lease."""
        self._active = False

    def renew(self, now_s: float) -> m.Lease | None:
        """Return the message of a renewal, None if no renewal is due."""
        age_s = now_s - self._sent_s
        if age_s < RENEWAL_FRACTION * self._lease_s:
            return None
        self._sent_s = now_s
        if self._active:
            self.ages.add(age_s)
            # Only between two renewals of one arming: the time before the first is no age.
            self.slack_s = min(self._lease_s if self.slack_s is None else self.slack_s, self._lease_s - age_s)
        self._active = True
        return m.Lease(ms=round(self._lease_s * 1e3))
