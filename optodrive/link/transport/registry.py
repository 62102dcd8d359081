"""Transports by their name in the configuration."""

from collections.abc import Callable
from functools import cache, partial
from importlib import import_module
from pkgutil import iter_modules

from optodrive.core.errors import InputError
from optodrive.device.config import BoardSection
from optodrive.link import transport
from optodrive.link.transport.base import Transport, TransportKind
from optodrive.link.transport.simulated import SimulatedBoard


@cache
def discover_transports() -> dict[str, Callable[[BoardSection], Transport]]:
    """Return the factory of every module in this package that has a TRANSPORT, by its name."""
    modules = [import_module(f"{transport.__name__}.{item.name}") for item in iter_modules(transport.__path__)]
    kinds: list[TransportKind] = [module.TRANSPORT for module in modules if hasattr(module, "TRANSPORT")]
    return {kind.name: kind.create for kind in kinds}


def find_transport_factory(board: BoardSection) -> Callable[[], Transport]:
    """Return a factory for the configured transport, which it does not open.

    Raise InputError for a Helios, which does not use the board's protocol.
    """
    factories = discover_transports()
    if board.transport not in factories:
        raise InputError(
            "board.transport",
            board.transport,
            f"one of {', '.join(sorted(factories))}: the daemon cannot use a Helios, see `optodrive helios play`",
        )
    return partial(factories[board.transport], board)


def build_bench_transport(board: BoardSection, display: str) -> tuple[Transport, str]:
    """Return an unopened transport and the port of its simulated spot sensor, '' without one.

    display: file or shipped name of the configuration
    """
    if board.transport == "simulated":
        simulated = SimulatedBoard(board.port, board.baud, display)
        return simulated, simulated.sensor_port
    return find_transport_factory(board)(), ""
