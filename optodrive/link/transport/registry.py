"""Transports by their name in the configuration."""

from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from pkgutil import iter_modules

from optodrive.core.errors import InputError
from optodrive.link import transport
from optodrive.link.transport.base import PortSettings, Transport, TransportKind
from optodrive.link.transport.simulated import SimulatedBoard


def iterate_transports() -> Iterator[TransportKind]:
    """Yield TRANSPORT or TRANSPORTS of every module in this package. A module is imported when its turn comes."""
    for item in iter_modules(transport.__path__):
        module = import_module(f"{transport.__name__}.{item.name}")
        if hasattr(module, "TRANSPORT"):
            yield module.TRANSPORT
        yield from getattr(module, "TRANSPORTS", ())


def find_transport_factory(port: PortSettings) -> Callable[[], Transport]:
    """Return a factory for the configured transport, which it does not open.

    Raise InputError for a laser DAC without a statement of an external interlock.
    """
    if port.interlock_watched is False:
        raise InputError(
            "board.interlock_watched",
            False,
            f"true once an external interlock cuts the laser: transport {port.transport!r} has none, and emits nothing",
        )
    names = []
    for kind in iterate_transports():  # the search ends before the libraries of other transports are imported
        if kind.name == port.transport:
            return partial(kind.create, port)
        names.append(kind.name)
    raise InputError(
        "board.transport",
        port.transport,
        f"one of {', '.join(sorted(names))}",
    )


def build_bench_transport(port: PortSettings, display: str, stage: str | None = None) -> tuple[Transport, str]:
    """Return an unopened transport and the port of its simulated spot sensor, '' without one.

    display: file or shipped name of the configuration; stage: whose board it is, None for the only one
    """
    if port.transport == "simulated":
        simulated = SimulatedBoard(port, display, stage)
        return simulated, simulated.sensor_port
    return find_transport_factory(port)(), ""
