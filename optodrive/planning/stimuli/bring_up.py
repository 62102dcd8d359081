"""Waveforms for an oscilloscope on the converter's outputs, for the bring-up of a board: weak pulses in turn."""

from optodrive.core.errors import InputError
from optodrive.core.types.stimuli import FrameSequence, PulseTrain
from optodrive.device.config import Config
from optodrive.planning.stimuli.pixel_lattice import Lattice

WAVEFORMS = ("steps-x", "steps-y", "square", "ramp-x", "ramp-y")
PULSE_S = 1e-3


def build_scope_waveform(
    config: Config, where: str, waveform: str, dwell_s: float, power_w: float, seconds: float
) -> FrameSequence:
    """Build a waveform: one pulse of PULSE_S per place, dwell_s apart, for `seconds`.

    The mirrors leave a place when its pulse ends, so the outputs step every dwell_s. Raises InputError (does_not_fit)
    for a display with a single pixel along the waveform.
    """
    places = _list_places(Lattice.from_config(config), waveform)
    if len(places) < 2:
        raise InputError(
            f"{where}: waveform", waveform, f"a display with several pixels along it, not {config.name}", "does_not_fit"
        )
    width_s = max(1, round(PULSE_S * config.laser.pwm_hz)) / config.laser.pwm_hz
    period_s = len(places) * dwell_s
    duration_s = max(1, round(seconds / period_s)) * period_s
    power_w = min(power_w, config.laser.max_power_w)
    return FrameSequence(
        (),
        tuple(
            PulseTrain(pixel, round(k * dwell_s, 6), duration_s, width_s, period_s - width_s, power_w)
            for k, pixel in enumerate(places)
        ),
    )


def _list_places(lattice: Lattice, waveform: str) -> list[int]:
    """Return the pixels of a waveform in the order of the visit, without repetitions."""
    layout, middle = lattice.layout, lattice.middle_pixel()
    row = [int(pixel) for pixel in lattice.index[layout.row[middle]] if pixel >= 0]
    column = [int(pixel) for pixel in lattice.index[:, layout.column[middle]] if pixel >= 0]
    match waveform:
        case "ramp-x":
            return row
        case "ramp-y":
            return column
        case "steps-x":
            return list(dict.fromkeys((row[0], row[-1])))
        case "steps-y":
            return list(dict.fromkeys((column[0], column[-1])))
    diagonal_m = {  # distance along the diagonals; the outermost pixels are the corners of the square
        signs: signs[0] * layout.x_m + signs[1] * layout.y_m for signs in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    }
    return list(dict.fromkeys(int(distance_m.argmax()) for distance_m in diagonal_m.values()))
