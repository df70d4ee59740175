"""Imports of learnt interfaces: `from weld_msgs.msg import Seam` in any process.

The finder is the last of `sys.meta_path`, so a compiled package of the same name takes precedence.
An interface is generated on the first use of its class.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from types import ModuleType

from rn_interfaces.store import KINDS, DefinitionStore, Name

_SUPPORT = "_s__rosidl_typesupport_c"
"""Suffix of the module with a compiled package's type supports."""
PREFIXES = "AMENT_PREFIX_PATH"


def install(store: DefinitionStore | None = None) -> None:
    """Make learnt interfaces importable in this process and its children; idempotent.

    Args:
        store: None for this user's store.
    """
    if any(isinstance(finder, InterfaceFinder) for finder in sys.meta_path):
        return
    found = store or DefinitionStore()
    sys.meta_path.append(InterfaceFinder(found))
    prefixes = [p for p in os.environ.get(PREFIXES, sys.prefix).split(os.pathsep) if p]
    if str(found.prefix) not in prefixes:  # where tools and recorder read definitions
        os.environ[PREFIXES] = os.pathsep.join([*prefixes, str(found.prefix)])


def attach(module: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a kind's package, such as `weld_msgs.msg`: a class is
    imported on first use.
    """
    finder = next(one for one in sys.meta_path if isinstance(one, InterfaceFinder))
    package, _, kind = module.partition(".")

    def find(word: str) -> object:
        if not word.startswith("_") and word in finder.store.words(package, kind):
            from rn_interfaces.cache import lowered

            found = getattr(import_module(f"{module}._{lowered(word)}"), word)
            setattr(sys.modules[module], word, found)  # messages import those inside them each time
            return found
        raise AttributeError(f"{module} has no interface {word!r}")

    return find, lambda: finder.store.words(package, kind)


class InterfaceFinder(MetaPathFinder):
    """Finds packages of the store, their kinds, and modules of single interfaces."""

    def __init__(self, store: DefinitionStore) -> None:
        self.store = store

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None = None,
        target: ModuleType | None = None,
    ) -> ModuleSpec | None:
        """See importlib; unknown names are left to other finders."""
        package, _, rest = fullname.partition(".")
        if not self.store.has_package(package):
            return None
        if rest == f"{package}{_SUPPORT}":
            return ModuleSpec(fullname, SupportLoader(self.store, package))
        if rest.startswith(KINDS) and "._" in rest:
            return self._interface(fullname, package, *rest.split(".", 1))
        if rest and not (rest in KINDS and self.store.words(package, rest)):
            return None
        from rn_interfaces.cache import packages

        folder = packages(self.store, package) / rest
        return spec_from_file_location(
            fullname, folder / "__init__.py", submodule_search_locations=[str(folder)]
        )

    def _interface(self, fullname: str, package: str, kind: str, module: str) -> ModuleSpec | None:
        name = self._named(package, kind, module.removeprefix("_"))
        if name is None:
            return None
        from rn_interfaces.cache import Cache  # it imports rosidl

        return spec_from_file_location(fullname, Cache(self.store).module(name))

    def _named(self, package: str, kind: str, lower: str) -> Name | None:
        from rn_interfaces.cache import lowered

        words = self.store.words(package, kind)
        return next((Name(package, kind, w) for w in words if lowered(w) == lower), None)


class SupportLoader(Loader):
    """Loader of the module with a package's type supports."""

    def __init__(self, store: DefinitionStore, package: str) -> None:
        self._store = store
        self._package = package

    def exec_module(self, module: ModuleType) -> None:
        """Create type supports on demand. Raises LayoutError, as `Supports`."""
        from rn_interfaces.cache import Cache
        from rn_interfaces.support import Supports

        cache = Cache(self._store)
        module.__getattr__ = Supports(self._package, cache.describe)  # type: ignore[method-assign]
