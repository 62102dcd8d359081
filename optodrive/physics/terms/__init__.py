"""Physical effects beyond the nominal pixel, one class per term, in one module per part of the display.

Other packages offer further ones as entry points.
"""

from collections.abc import Collection
from functools import cache
from importlib import import_module
from pkgutil import iter_modules

from optodrive.core.errors import MISSING, InputError, suggest_nearest
from optodrive.core.plug_ins import PlugIns, find_plug_ins
from optodrive.physics import discovered_term
from optodrive.physics.term import Term
from optodrive.physics.term_plug_ins import PLUG_INS, check_term


@cache
def _list_own_terms() -> dict[str, Term]:
    """Return one of each class of terms that a module of this package defines, by key."""
    modules = [import_module(f"{__name__}.{item.name}") for item in iter_modules(__path__)]
    found = [value for module in modules for value in vars(module).values() if isinstance(value, type)]
    # What a module only imports is another one's, and `Term` itself is none.
    terms = [kind() for kind in found if issubclass(kind, Term) and kind.__module__.startswith(f"{__name__}.")]
    return {term.key: term for term in terms}


@cache
def load_plug_ins() -> PlugIns[Term]:
    """Return the terms of other packages."""

    def check(name: str, kind: object, package: str) -> Term:
        if name in _list_own_terms() or name == discovered_term.KEY:
            raise ValueError("another term has this name")
        term = check_term(name, kind)
        for needed in term.requires:
            if needed not in _list_own_terms():
                raise ValueError(f"requires {needed}: a term of optodrive is expected")
        return term

    return find_plug_ins(PLUG_INS, check)


@cache
def discover_terms() -> dict[str, Term]:
    """Return every term by its key, those of other packages too."""
    return dict(sorted({**_list_own_terms(), **load_plug_ins().found}.items()))


@cache
def all_terms() -> dict[str, Term]:
    """Return every term by its key, with the term of discovered functions, which is in no catalogue."""
    return {**discover_terms(), discovered_term.KEY: discovered_term.Discovered()}


def find_term(where: str, key: str, given: Collection[str]) -> Term:
    """Return the term of a key whose parameters are given by name.

    where: place of the term in its file, for the message. Raises InputError for an unknown term, an unknown parameter
    and a missing parameter that has no value of its own.
    """
    if (reason := load_plug_ins().broken.get(key)) is not None:
        raise InputError(where, key, f"one that can be used ({reason})", code="broken_plug_in")
    if key not in discover_terms():
        raise InputError(where, key, f"a known term, {suggest_nearest(key, sorted(discover_terms()))}")
    term, names = discover_terms()[key], set(given)
    expected = [item.name for item in term.parameters]
    required = [item.name for item in term.parameters if item.if_omitted is None]
    for name in sorted(names.difference(expected)):
        raise InputError(f"{where}.{name}", name, f"a parameter of the term, {suggest_nearest(name, sorted(expected))}")
    for name in required or ([] if names else expected[:1]):
        if name not in names:
            raise InputError(f"{where}.{name}", MISSING, "a value for this parameter")
    return term


def check_requirements(where: str, keys: Collection[str]) -> None:
    """Raise InputError if one of these known terms lacks another one that it builds on."""
    for key in keys:
        for required in discover_terms()[key].requires:
            if required not in keys:
                raise InputError(f"{where}.{key}", f"without {required}", f"terms.{required} as well")
