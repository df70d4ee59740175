"""Classes made of learnt texts, each in a folder of the user's cache that is named by a digest of
all that it was made of. What is there is never changed, so that processes may share it.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

from rn_interfaces.definitions import by_package, used_by
from rn_interfaces.description import TypeDescription, TypeSource
from rn_interfaces.store import KINDS, Name, Store, write
from roboneuron import ConfigurationError

_TIMEOUT_S = 120.0
"""Of the generators: less than a second each, on a machine that is busy with other starts."""
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


def packages(store: Store, package: str) -> Path:
    """Folder of a package's `__init__.py` and those of its kinds, for what looks at folders."""
    folder = default_folder() / PACKAGES / package
    for kind in ("", *(kind for kind in KINDS if store.words(package, kind))):
        path = folder / kind / "__init__.py"
        if not path.is_file():
            write(path, _OF_KIND if kind else _OF_PACKAGE)
    return folder


def installed(package: str, besides: Path) -> Path | None:
    """The folder of a package of the wheels or of another prefix, with `<kind>/<Name>.json`.

    Args:
        package: that is looked for.
        besides: a prefix that does not count, that of the store.
    """
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    for prefix in (*prefixes, sys.prefix):
        folder = Path(prefix) / "share" / package
        if prefix and Path(prefix) != besides and next(folder.glob("*/*.json"), None) is not None:
            return folder
    return None


class Cache:
    """The cache of what is in a store."""

    def __init__(self, store: Store, folder: Path | None = None) -> None:
        """`folder` is `default_folder()` when None; it need not exist."""
        self._store = store
        self._folder = folder or default_folder()

    def module(self, name: Name) -> Path:
        """The file of an interface's classes, made now where it is not there.

        Raises
        ------
        ConfigurationError
            Something that it uses is not known, or the generators do not take its text.
        """
        return self._made(name) / f"_{lowered(name.word)}.py"

    def describe(self, full_name: str) -> TypeDescription:
        """The description of an interface or of a part of one, such as
        `weld_msgs/srv/Strike_Request`; raises as `module`.
        """
        package, kind, word = full_name.split("/")
        name = Name(package, kind, word.partition("_")[0])
        source = (
            TypeSource(full_name, kind, self._store.text(name))
            if word == name.word
            else TypeSource(full_name, "implicit", "")
        )
        return TypeDescription(self._made(name) / f"{word}.json", source)

    def _made(self, name: Name) -> Path:
        used = self._closure(name)
        places = {one: self._folder / self._key(one, used) for one in used}
        if not places[name].is_dir():
            self._make({one: place for one, place in places.items() if not place.is_dir()}, used)
        return places[name]

    def _closure(self, name: Name) -> dict[Name, frozenset[Name]]:
        """What learnt interfaces use, from one on."""
        found: dict[Name, frozenset[Name]] = {}
        waiting = [name]
        while waiting:
            one = waiting.pop()
            if one in found:
                continue
            if not self._store.has(one):
                if installed(one.package, self._store.prefix) is None:
                    raise ConfigurationError(
                        f"{name} uses {one}, which is not known.",
                        hint="Learn it too: `roboneuron ros learn graph`, or a folder that has it.",
                    )
                continue
            found[one] = used_by(one, self._store.text(one))
            waiting += found[one]
        return found

    def _key(self, name: Name, used: dict[Name, frozenset[Name]]) -> str:
        digest = hashlib.sha256(f"{generators()} {name}\n{self._store.text(name)}".encode())
        for other in sorted(used[name]):
            if other in used:
                digest.update(self._key(other, used).encode())
                continue
            folder = installed(other.package, self._store.prefix)
            assert folder is not None  # as `_closure` has found
            path = folder / other.kind / f"{other.word}.json"
            digest.update(path.read_bytes() if path.is_file() else b"")
        return digest.hexdigest()[:40]

    def _make(self, places: dict[Name, Path], used: dict[Name, frozenset[Name]]) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=self._folder, prefix=".new-") as scratch:
            work = Path(scratch)
            for name in used.keys() - places.keys():  # made before: descriptions are enough
                made = self._folder / self._key(name, used) / f"{name.word}.json"
                target = work / name.package / name.kind / made.name
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(made, target)
            others = {one.package for uses in used.values() for one in uses if one not in used}
            includes = {one: str(installed(one, self._store.prefix)) for one in others}
            steps = [
                (names[0].package, [f"{name.kind}/{name.word}" for name in names])
                for names in by_package({name: used[name] for name in places})
            ]
            plan = {
                "texts": str(self._store.share),
                "work": scratch,
                "includes": includes,
                "steps": steps,
            }
            run_generators(plan, ", ".join(map(str, sorted(places))))
            for name, place in places.items():
                self._keep(work / name.package / name.kind, name, place)

    def _keep(self, made: Path, name: Name, place: Path) -> None:
        with TemporaryDirectory(dir=self._folder, prefix=".new-") as scratch:
            folder = Path(scratch) / "made"
            folder.mkdir()
            files = [*made.glob(f"{name.word}.json"), *made.glob(f"{name.word}_*.json")]
            for path in (*files, made / f"_{lowered(name.word)}.py"):
                shutil.copyfile(path, folder / path.name)
            try:
                folder.rename(place)
            except OSError:
                if not place.is_dir():  # another process was first: what it has made is equal
                    raise


@cache
def generators() -> str:
    """Versions of what classes are made by."""
    names = ("generator-py", "generator-type-description", "adapter")
    return " ".join(version(f"ros-rosidl-{name}") for name in names)


def lowered(word: str) -> str:
    """`joint_state` for `JointState`, as rosidl names modules."""
    from rosidl_pycommon import (  # type: ignore[import-untyped]
        convert_camel_case_to_lower_case_underscore,
    )

    found: str = convert_camel_case_to_lower_case_underscore(word)
    return found


def run_generators(plan: dict[str, object], what: str) -> None:
    """Run the generators in a process of their own; see `rn_interfaces.generate.main`.

    Raises
    ------
    ConfigurationError
        They fail; with their last words.
    """
    command = [sys.executable, "-P", "-m", "rn_interfaces.generate"]
    try:
        subprocess.run(
            command,
            input=json.dumps(plan),
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=True,
        )
    except subprocess.TimeoutExpired as error:
        raise ConfigurationError(f"Making {what} took more than {_TIMEOUT_S:g} s.") from error
    except subprocess.CalledProcessError as error:
        last = (error.stderr.strip().splitlines() or ["without a word"])[-1]
        raise ConfigurationError(f"{what} cannot be made: {last[:300]}") from error
