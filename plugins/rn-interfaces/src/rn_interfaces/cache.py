"""Cache of generated classes of learnt interfaces, each in a folder of the user's cache named by a
digest of its sources. Existing entries are never changed, so that processes may share them.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

from rn_interfaces.asking import ask_each
from rn_interfaces.described import read_facts, used_types
from rn_interfaces.description import TypeDescription, TypeSource
from rn_interfaces.generate import FORM
from rn_interfaces.store import KINDS, DefinitionStore, Name, parse_name, write
from roboneuron import ConfigurationError

PACKAGES = "packages"
_OF_PACKAGE = '"""Interfaces made at run time."""\n'
_OF_KIND = f"""{_OF_PACKAGE}
from rn_interfaces.finder import attach

__getattr__, __dir__ = attach(__name__)
"""


def default_folder() -> Path:
    """The cache of this user: below XDG_CACHE_HOME."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "roboneuron" / "interfaces"


def packages(store: DefinitionStore, package: str) -> Path:
    """Folder of a package's `__init__.py` and those of its kinds, for code that searches
    folders.
    """
    folder = default_folder() / PACKAGES / package
    for kind in ("", *(kind for kind in KINDS if store.words(package, kind))):
        path = folder / kind / "__init__.py"
        if not path.is_file():
            write(path, _OF_KIND if kind else _OF_PACKAGE)
    return folder


def installed(package: str, besides: Path) -> Path | None:
    """Folder of a package in the wheels or another prefix, with `<kind>/<Name>.json`.

    Args:
        package: the package.
        besides: a prefix to be ignored, that of the store.
    """
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    for prefix in (*prefixes, sys.prefix):
        folder = Path(prefix) / "share" / package
        if prefix and Path(prefix) != besides and next(folder.glob("*/*.json"), None) is not None:
            return folder
    return None


class Cache:
    """Cache of a store's interfaces."""

    def __init__(self, store: DefinitionStore) -> None:
        self._store = store
        self._folder = default_folder()

    def module(self, name: Name) -> Path:
        """The file of an interface's classes, made now where it is not there; those of learnt
        interfaces that it uses are made with it.

        Raises
        ------
        ConfigurationError
            The generators fail.
        """
        place = self._place(name)
        if not place.is_file():
            failed = self.make([name, *filter(self._store.has, self._used(name))])
            for one, reason in failed.items():
                raise ConfigurationError(f"{one} cannot be made: {reason}.")
        return place

    def make(self, names: Iterable[Name]) -> dict[Name, str]:
        """Make the files of those that have none; return why others cannot be made."""
        places = {name: self._place(name) for name in {*names}}
        lacking = {name: place for name, place in places.items() if not place.is_file()}
        return self._make(lacking) if lacking else {}

    def describe(self, full_name: str) -> TypeDescription:
        """The description of an interface or of a part of one, such as
        `weld_msgs/srv/Strike_Request`.
        """
        path = self._store.share / f"{full_name}.json"
        facts = read_facts(path)
        names = [full_name, *used_types(facts)]
        return TypeDescription(facts, [self._source(one) for one in names])

    def _source(self, full_name: str) -> TypeSource:
        if "_" in full_name.rpartition("/")[2]:
            return TypeSource(full_name, "implicit", "")
        name = parse_name(full_name)
        folder = installed(name.package, self._store.prefix) or self._store.share / name.package
        path = folder / name.kind / f"{name.word}.{name.kind}"
        if not path.is_file():
            return TypeSource(full_name, "implicit", "")
        return TypeSource(full_name, name.kind, path.read_text(encoding="utf-8"))

    def _used(self, name: Name) -> list[Name]:
        path = (self._store.share / name.file).with_suffix(".json")
        names = used_types(read_facts(path))
        return [parse_name(one) for one in names if "_" not in one.rpartition("/")[2]]

    def _place(self, name: Name) -> Path:
        idl = (self._store.share / name.file).with_suffix(".idl").read_text(encoding="utf-8")
        made_by = f"{generators()} {FORM}"
        digest = hashlib.sha256(f"{made_by} {name}\n{idl}".encode()).hexdigest()[:40]
        return self._folder / digest / f"_{lowered(name.word)}.py"

    def _make(self, places: Mapping[Name, Path]) -> dict[Name, str]:
        self._folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=self._folder, prefix=".new-") as scratch:
            work = Path(scratch)
            for name in places:
                for path in (name.file.with_suffix(".idl"), name.file.with_suffix(".json")):
                    (work / path).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(self._store.share / path, work / path)
            failed = ask_each("rn_interfaces.generate", work, sorted(places))
            for name in places.keys() - failed.keys():
                made = work / name.package / name.kind / places[name].name
                write(places[name], made.read_text(encoding="utf-8"))
        return failed


@cache
def generators() -> str:
    """Versions of the generators."""
    return " ".join(version(f"ros-rosidl-{name}") for name in ("generator-py", "parser"))


def lowered(word: str) -> str:
    """`joint_state` for `JointState`, as rosidl names modules."""
    from rosidl_pycommon import (  # type: ignore[import-untyped]
        convert_camel_case_to_lower_case_underscore,
    )

    found: str = convert_camel_case_to_lower_case_underscore(word)
    return found
