"""Store of learnt interfaces in the user's data directory, laid out as an ament prefix:
`share/<package>/<kind>/<Name>.<kind>`, so that other programs find the definitions.

It uses the standard library only, because every process imports it.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import NamedTuple

from roboneuron import ConfigurationError, ForeignDataError, foreign

KINDS = ("msg", "srv", "action")
MOST_INTERFACES = 5000
"""Maximum number of interfaces in the store: a full installation of ROS has about 1,500."""
MOST_TEXT = 262_144
"""Maximum length of one text [B]."""
_NAME = re.compile(r"([a-z][a-z0-9_]{0,99})/(msg|srv|action)/([A-Z][A-Za-z0-9]{0,99})")
_INDEX = Path("ament_index", "resource_index", "rosidl_interfaces")
_ORIGINS = "origins.json"
_MOST_ORIGINS = 8 << 20


class Name(NamedTuple):
    """Full name of an interface, written `package/kind/Name`."""

    package: str
    kind: str
    word: str

    def __str__(self) -> str:
        return "/".join(self)

    @property
    def file(self) -> Path:
        """Path below `share`."""
        return Path(self.package, self.kind, f"{self.word}.{self.kind}")


def parse_name(text: str) -> Name:
    """Parse a full name of an interface. Raises ConfigurationError if it is invalid."""
    found = _NAME.fullmatch(text)
    if found is None:
        raise ConfigurationError(
            f"{text[:120]!r} is not the name of an interface.",
            hint="Write it as package/msg/Name, package/srv/Name or package/action/Name.",
        )
    return Name(*found.groups())


class Origin(NamedTuple):
    """Origin of a text.

    Attributes:
        source: such as a path, or the queried node.
        type_hash: its RIHS01.
    """

    source: str
    type_hash: str


class Interface(NamedTuple):
    """Stored data of one interface.

    Attributes:
        text: its definition.
        idl: rosidl's translation of it.
        descriptions: JSON texts of it and of its parts, by name, such as `Strike_Request`.
        origin: origin of the text.
    """

    text: str
    idl: str
    descriptions: Mapping[str, str]
    origin: Origin


def default_folder() -> Path:
    """The store of this user: below XDG_DATA_HOME."""
    base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(base) / "roboneuron" / "interfaces"


class DefinitionStore:
    """Store that reads the disk at every call, so that changes by other processes are visible at
    once.
    """

    def __init__(self, prefix: Path | None = None) -> None:
        """`prefix` is `default_folder()` at the time of each call when None; it need not exist."""
        self._prefix = prefix

    @property
    def prefix(self) -> Path:
        """The ament prefix of the store."""
        return self._prefix or default_folder()

    @property
    def share(self) -> Path:
        """Its folder of definitions."""
        return self.prefix / "share"

    def has_package(self, package: str) -> bool:
        """True if any interface of a package is learnt."""
        return (self.share / _INDEX / package).is_file()

    def has(self, name: Name) -> bool:
        """True if an interface is learnt."""
        return (self.share / name.file).is_file()

    def text(self, name: Name) -> str:
        """Definition of an interface. Raises FileNotFoundError."""
        return (self.share / name.file).read_text(encoding="utf-8")

    def description(self, name: Name) -> str:
        """rosidl's JSON description of an interface. Raises FileNotFoundError."""
        return (self.share / name.file).with_suffix(".json").read_text(encoding="utf-8")

    def words(self, package: str, kind: str) -> list[str]:
        """Names of a package's interfaces of a kind, sorted."""
        return sorted(path.stem for path in (self.share / package / kind).glob(f"*.{kind}"))

    def names(self) -> list[Name]:
        """All of them, sorted."""
        folder = self.share / _INDEX
        packages = sorted(entry.name for entry in folder.iterdir()) if folder.is_dir() else []
        return [
            Name(package, kind, word)
            for package in packages
            for kind in sorted(KINDS)
            for word in self.words(package, kind)
        ]

    def origins(self) -> dict[str, Origin]:
        """Origin by full name. Raises ConfigurationError if the file is damaged."""
        path = self.prefix / _ORIGINS
        try:
            facts = foreign.read_json(path, most_bytes=_MOST_ORIGINS)
            return {
                name: Origin(*(foreign.text(word, name, MOST_TEXT) for word in _pair(name, origin)))
                for name, origin in foreign.table(facts, "it", MOST_INTERFACES).items()
            }
        except FileNotFoundError:
            return {}
        except ForeignDataError as error:
            raise ConfigurationError(
                f"{path} is damaged: {error.message}.",
                hint="Remove it: it only says where interfaces were learnt, which stay.",
            ) from error

    def origin(self, name: Name) -> Origin:
        """Origin of a learnt interface; an unknown one if the list of origins was removed."""
        return self.origins().get(str(name), Origin("an unknown source", ""))

    def add(self, learnt: Mapping[Name, Interface]) -> None:
        """Store texts, replacing earlier ones of the same names; all files are replaced atomically.

        Raises:
            ConfigurationError: they are too many, or the folder cannot be written.
        """
        try:
            self.prefix.mkdir(parents=True, exist_ok=True)
            with self._locked():
                self._add(learnt)
        except OSError as error:
            raise ConfigurationError(
                f"Interfaces cannot be kept in {self.prefix}: {error.strerror or error}.",
                hint="Make it writable, or name another folder with XDG_DATA_HOME.",
            ) from error

    def _add(self, learnt: Mapping[Name, Interface]) -> None:
        names = {*self.names(), *learnt}
        if len(names) > MOST_INTERFACES:
            raise ConfigurationError(
                f"{self.prefix} would hold {len(names)} interfaces, {MOST_INTERFACES} are allowed.",
                hint="Forget packages that you do not use: `roboneuron ros forget PACKAGE`.",
            )
        origins = self.origins()
        for name, (text, idl, descriptions, origin) in learnt.items():
            path = self.share / name.file
            write(path.with_suffix(".idl"), idl)
            for word, description in descriptions.items():
                write(path.with_name(f"{word}.json"), description)
            write(path, text)
            origins[str(name)] = origin
        self._write_origins(origins)
        # last, because a listed package must be complete
        for package in {name.package for name in learnt}:
            listed = [n.file.relative_to(package) for n in sorted(names) if n.package == package]
            write(self.share / _INDEX / package, "".join(f"{path}\n" for path in listed))

    def forget(self, package: str) -> int:
        """Remove a package and return the number of its interfaces."""
        if not self.prefix.is_dir():
            return 0
        with self._locked():
            names = [name for name in self.names() if name.package == package]
            (self.share / _INDEX / package).unlink(missing_ok=True)
            for name in names:
                path = self.share / name.file
                for file in (path, path.with_suffix(".idl"), path.with_suffix(".json")):
                    file.unlink(missing_ok=True)
                for part in path.parent.glob(f"{name.word}_*.json"):
                    part.unlink()
            gone = set(map(str, names))
            self._write_origins({n: o for n, o in self.origins().items() if n not in gone})
        return len(names)

    def _write_origins(self, origins: Mapping[str, Origin]) -> None:
        write(self.prefix / _ORIGINS, json.dumps(origins, indent=1, sort_keys=True))

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with (self.prefix / ".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield


def _pair(name: str, origin: object) -> list[object]:
    return foreign.items(origin, name, least=2, most=2)


def write(path: Path, text: str) -> None:
    """Replace a file atomically, so that no reader sees a part of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with NamedTemporaryFile(
        "w", dir=path.parent, prefix=".new-", delete=False, encoding="utf-8"
    ) as file:
        file.write(text)
    os.replace(file.name, path)
