"""Formats of the laser DACs by their transport in the configuration."""

from optodrive.core.errors import InputError
from optodrive.core.quantity import format_quantity
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


def describe_limitation(transport: str) -> str | None:
    """Return the limitation of a laser DAC against a board in one text, None for a board."""
    if transport not in FORMATS:
        return None
    dac_format = FORMATS[transport]
    stop = "" if dac_format.stops_at_once else "STOP or "
    return (
        "Laser DAC: no interlock, key or emergency stop of its own; yours must cut the laser. After "
        f"{stop}the death of this computer it emits for up to {format_quantity(dac_format.host_loss_max_s, 's')}."
    )
