"""Formats of the laser DACs by their transport in the configuration."""

from optodrive.core.errors import InputError
from optodrive.link.dac.dac_format import DacFormat
from optodrive.link.dac.devices.helios_frames import HELIOS

FORMATS: dict[str, DacFormat] = {"helios": HELIOS}


def find_format(transport: str) -> DacFormat:
    """Return the format of a transport. Raise InputError unless it is that of a laser DAC."""
    if transport not in FORMATS:
        raise InputError("board.transport", transport, f"that of a laser DAC: {', '.join(FORMATS)}")
    return FORMATS[transport]
