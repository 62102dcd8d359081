"""Physical effects beyond the nominal pixel, one file each; a new file here is a new term, nothing else changes."""

from collections.abc import Collection
from functools import cache
from importlib import import_module
from pkgutil import iter_modules

from optodrive.core.errors import InputError, suggest_nearest
from optodrive.physics.term import Term


@cache
def discover_terms() -> dict[str, Term]:
    """Every term by its key: each module of this package holds one, named TERM."""
    modules = (import_module(f"{__name__}.{item.name}") for item in iter_modules(__path__))
    terms: list[Term] = [module.TERM for module in modules]
    return {term.key: term for term in terms}


def find_term(where: str, key: str, given: Collection[str]) -> Term:
    """The term of a key, given parameters by these names; InputError unless they are its own, all of them."""
    if key not in discover_terms():
        raise InputError(where, key, f"a known term, {suggest_nearest(key, sorted(discover_terms()))}")
    term, names = discover_terms()[key], set(given)
    wanted = [item.name for item in term.parameters]
    for name in sorted(names.difference(wanted)):
        raise InputError(f"{where}.{name}", name, f"a parameter of it, {suggest_nearest(name, sorted(wanted))}")
    for name in wanted:
        if name not in names:
            raise InputError(f"{where}.{name}", None, "this parameter to be there")
    return term


def check_requirements(where: str, keys: Collection[str]) -> None:
    """InputError where a known term lacks one that it builds on."""
    for key in keys:
        for need in discover_terms()[key].requires:
            if need not in keys:
                raise InputError(f"{where}.{key}", f"without {need}", f"terms.{need} beside it")
