"""First light: single weak pulses at the centre of the display, after the checks of homing that need no light."""

from collections.abc import Callable

from optodrive.core.errors import InputError
from optodrive.device.config import Config
from optodrive.lab.commissioning.exclusive_board import ExclusiveBoard
from optodrive.lab.commissioning.homing import DARK_STEPS, Homing, HomingResult
from optodrive.lab.commissioning.spot_bounds import max_spot_power_w
from optodrive.link.protocol.quantisation import CENTRE_CODE

DUTY_SHARE = 0.01
"""Default power as a share of the laser's: at less, the gate's readback of the reference board detects no light."""
PULSES_MAX = 100
PULSE_INTERVAL_S = 1.0


def default_power_w(config: Config) -> float:
    """Return the lowest power that is emitted and that the reference board's readback detects, at most a spot's, W."""
    lowest_w = max(DUTY_SHARE * config.laser.max_power_w, config.laser.threshold_w)
    return min(lowest_w, max_spot_power_w(config))


def emit_first_light(
    board: ExclusiveBoard, power_w: float, pulses: int, acknowledge: bool, on_step: Callable[[HomingResult], None]
) -> None:
    """Check link, state, inputs and indicator, centre the mirrors, emit the pulses one per second, and disarm.

    Raises InputError for a power beyond that of a spot or a number of pulses outside 1 to PULSES_MAX, RefusedError for
    a failed check, and errors of the board as ExclusiveBoard.
    """
    if not 1 <= pulses <= PULSES_MAX:
        raise InputError("--pulses", pulses, f"1 to {PULSES_MAX}")
    Homing(board, None, 0.0, acknowledge).run(on_step, DARK_STEPS)
    board.move_to(CENTRE_CODE, CENTRE_CODE)
    for number in range(1, pulses + 1):
        if number > 1:
            board.wait(PULSE_INTERVAL_S)
        board.fire_spot(CENTRE_CODE, CENTRE_CODE, power_w)
        on_step(HomingResult("light", f"pulse {number} of {pulses} executed", {"pulse": number}))
    board.disarm()
    on_step(HomingResult("end", "gate off, DISARMED", {"board": str(board.session.board.state)}))
