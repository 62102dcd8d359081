"""Physical effects beyond the nominal pixel, one file each; a new file here is a new term, nothing else changes."""

from functools import cache
from importlib import import_module
from pkgutil import iter_modules

from optodrive.physics.term import Term


@cache
def known_terms() -> dict[str, Term]:
    """Every term by its key: each module of this package holds one, named TERM."""
    modules = (import_module(f"{__name__}.{item.name}") for item in iter_modules(__path__))
    terms: list[Term] = [module.TERM for module in modules]
    return {term.key: term for term in terms}
