"""Plug-ins: entry points of other packages, by name."""

from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Generic, NamedTuple, TypeVar

T = TypeVar("T")


class PlugIns(NamedTuple, Generic[T]):
    """Plug-ins of one group by name, and why others cannot be used, by name."""

    found: Mapping[str, T]
    broken: Mapping[str, str]


def find_plug_ins(group: str, check: Callable[[str, object, str], T]) -> PlugIns[T]:
    """Import the plug-ins of a group. One that cannot be imported or used costs only itself.

    check: returns the plug-in of a name from the object that its entry point names and its package's name, or raises
    """
    found: dict[str, T] = {}
    broken: dict[str, str] = {}
    for point in entry_points(group=group):
        package = point.dist.name if point.dist is not None else point.value
        try:
            if point.name in found:
                raise ValueError("another plug-in has this name")
            found[point.name] = check(point.name, point.load(), package)
        except (Exception, SystemExit) as error:  # the code of others
            broken[point.name] = f"{package}: {type(error).__name__}: {' '.join(str(error).split())}"
    return PlugIns({name: each for name, each in found.items() if name not in broken}, broken)
