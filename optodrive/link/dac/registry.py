"""Drivers of the laser DACs by their transport in the configuration."""

from optodrive.core.clock import Clock
from optodrive.core.errors import InputError
from optodrive.device.config_sections import BoardSection
from optodrive.link.dac.formats.registry import FORMATS
from optodrive.link.dac.laser_dac import LaserDac


def build_dac(board: BoardSection, clock: Clock) -> LaserDac:
    """Return the unopened driver of the configured DAC. Raise InputError if the transport is not that of a DAC.

    A driver is imported with its device, because a network DAC needs no USB library.
    """
    if board.transport == "helios":
        from optodrive.link.dac.devices.helios import Helios

        return Helios(board, clock)
    if board.transport == "ether_dream":
        from optodrive.link.dac.devices.ether_dream import EtherDream

        return EtherDream(board, clock)
    if board.transport == "idn":
        from optodrive.link.dac.devices.idn import Idn

        return Idn(board, clock)
    raise InputError("board.transport", board.transport, f"that of a laser DAC: {', '.join(FORMATS)}")
