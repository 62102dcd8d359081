"""Import every module of the package, so that Python writes bytecode of it and of the libraries that it uses."""

from contextlib import suppress
from importlib import import_module
from pkgutil import walk_packages

import optodrive

for module in walk_packages(optodrive.__path__, "optodrive."):
    with suppress(ImportError):  # of an extra that is not installed
        import_module(module.name)
