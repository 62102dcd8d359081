"""Formats of the laser DACs by their transport in the configuration."""

from optodrive.core.errors import InputError
from optodrive.link.dac.formats.base import DacFormat
from optodrive.link.dac.formats.ether_dream import EtherDreamFormat
from optodrive.link.dac.formats.helios import HeliosFormat
from optodrive.link.dac.formats.idn import IdnFormat

FORMATS: dict[str, type[DacFormat]] = {"helios": HeliosFormat, "ether_dream": EtherDreamFormat, "idn": IdnFormat}


def find_format(transport: str) -> type[DacFormat]:
    """Return the format of a transport. Raise InputError unless it is that of a laser DAC."""
    if transport not in FORMATS:
        raise InputError("board.transport", transport, f"that of a laser DAC: {', '.join(FORMATS)}")
    return FORMATS[transport]
