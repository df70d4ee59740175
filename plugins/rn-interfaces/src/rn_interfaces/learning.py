"""Learning of interfaces from their texts: dependencies are looked up, rosidl translates and hashes
them, and invalid ones are refused with a reason.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import NamedTuple

from rn_interfaces.cache import installed
from rn_interfaces.definitions import by_package, used_by
from rn_interfaces.generate import describe
from rn_interfaces.graph import described_hashes
from rn_interfaces.store import DefinitionStore, Interface, Name, Origin, write
from rn_interfaces.stores import known_definition
from roboneuron import ConfigurationError


class FoundDefinition(NamedTuple):
    """A found definition.

    Attributes:
        text: content of the file.
        source: place of the definition.
        hashes: RIHS01 announced by nodes, for the type or parts such as
            `weld_msgs/srv/Strike_Request`.
    """

    text: str
    source: str
    hashes: Mapping[str, str] = MappingProxyType({})


@dataclass(kw_only=True, slots=True)
class Learnt:
    """Result of learning, by full name.

    Attributes:
        added: with the hash, also for replaced definitions.
        known: already stored with the same text.
        compiled: packages that are installed, whose compiled types are used.
        refused: with the reason.
    """

    added: dict[Name, str] = field(default_factory=dict)
    known: set[Name] = field(default_factory=set)
    compiled: set[str] = field(default_factory=set)
    refused: dict[Name, str] = field(default_factory=dict)


def learn(store: DefinitionStore, texts: Mapping[Name, FoundDefinition]) -> Learnt:
    """Keep definitions, and those of rosbags' stores that they need.

    Raises
    ------
    ConfigurationError
        The store cannot take them.
    """
    learnt = Learnt()
    lesson = _Lesson(store, learnt)
    for name, text in texts.items():
        lesson.take(name, text)
    lesson.complete()
    store.add(lesson.made())
    return learnt


class _Lesson:
    def __init__(self, store: DefinitionStore, learnt: Learnt) -> None:
        self._store = store
        self._learnt = learnt
        self._texts: dict[Name, FoundDefinition] = {}
        self._used: dict[Name, frozenset[Name]] = {}

    def take(self, name: Name, text: FoundDefinition) -> None:
        if installed(name.package, besides=self._store.prefix) is not None:
            self._learnt.compiled.add(name.package)
            return
        try:
            self._used[name] = used_by(name, text.text)
        except ConfigurationError as error:
            self._learnt.refused[name] = error.message
        else:
            self._texts[name] = text

    def complete(self) -> None:
        """Look up dependencies, and refuse interfaces with an unknown one."""
        self._take_dependents()
        waiting = list(self._used)
        while waiting:
            name = waiting.pop()
            if name not in self._used:
                continue
            for other in self._used[name] - self._used.keys():
                if self._is_installed(other):
                    continue
                found = self._look_up(other)
                if found is None:
                    self._refuse(name, f"{name} uses {other}, which is not known")
                    break
                self.take(other, found)
                waiting.append(other)

    def _take_dependents(self) -> None:
        """Learn stored interfaces again if they use one whose text changes."""
        changed = {
            name
            for name, text in self._texts.items()
            if self._store.has(name) and self._store.text(name) != text.text
        }
        while changed:
            name = changed.pop()
            for other in self._store.names():
                if other in self._used or name not in used_by(other, self._store.text(other)):
                    continue
                source = self._store.origins()[str(other)].source
                self.take(other, FoundDefinition(self._store.text(other), source))
                changed.add(other)

    def _is_installed(self, name: Name) -> bool:
        folder = installed(name.package, besides=self._store.prefix)
        return folder is not None and (folder / name.kind / f"{name.word}.json").is_file()

    def _look_up(self, name: Name) -> FoundDefinition | None:
        if name in self._learnt.refused:
            return None
        if self._store.has(name):
            return FoundDefinition(self._store.text(name), self._store.origins()[str(name)].source)
        return known_definition(name)

    def _refuse(self, name: Name, reason: str) -> None:
        self._learnt.refused[name] = reason
        del self._used[name]
        for other in [other for other, used in self._used.items() if name in used]:
            self._refuse(other, f"{other} uses {name}, which is refused")

    def made(self) -> dict[Name, Interface]:
        """Interfaces to be stored, with their IDL and description."""
        with TemporaryDirectory() as scratch:
            texts, work = Path(scratch, "texts"), Path(scratch, "work")
            for name in self._used:
                write(texts / name.file, self._texts[name].text)
            work.mkdir()
            made: dict[Name, Interface] = {}
            for names in by_package(self._used):
                # one by one only if a package has a definition that rosidl refuses
                self._describe(names, texts, work)
            for name in list(self._used):
                self._keep(name, work, made)
        return {name: one for name, one in made.items() if name in self._learnt.added}

    def _describe(self, names: Iterable[Name], texts: Path, work: Path) -> None:
        left = [name for name in names if name in self._used]
        while left:
            error = self._translate(left, texts, work)
            if error is None:
                return
            culprit = next(
                (one for one in left if self._translate([one], texts, work) is not None), left[0]
            )
            self._refuse(culprit, f"rosidl does not take {culprit}: {error}")
            left = [name for name in left if name in self._used]

    def _translate(self, names: list[Name], texts: Path, work: Path) -> str | None:
        package = names[0].package
        others = {other.package for name in names for other in self._used[name]}
        found = {one: installed(one, besides=self._store.prefix) for one in others}
        includes = {one: folder for one, folder in found.items() if folder is not None}
        listed = [f"{name.kind}/{name.word}" for name in names]
        try:
            with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
                describe(package, listed, texts, work, includes)
        except Exception as error:  # of lark, empy and the generators, which have no common base
            return " ".join(str(error).split())[:200] or type(error).__name__
        return None

    def _keep(self, name: Name, work: Path, made: dict[Name, Interface]) -> None:
        text, source, expected = self._texts[name]
        place = work / name.package / name.kind
        files = [place / f"{name.word}.json", *place.glob(f"{name.word}_*.json")]
        descriptions = {path.stem: path.read_text(encoding="utf-8") for path in files}
        hashes = described_hashes(descriptions[name.word])
        for part, announced in expected.items():
            if announced != hashes.get(part):
                self._refuse(
                    name,
                    f"{part} of {source} gives {hashes.get(part)}, but the node says {announced}: "
                    "its definition is not the one that it was built with",
                )
                return
        found = hashes[str(name)]
        if (
            self._store.has(name)
            and self._store.text(name) == text
            and self._store.description(name) == descriptions[name.word]
        ):
            self._learnt.known.add(name)
            return
        idl = (place / f"{name.word}.idl").read_text(encoding="utf-8")
        self._learnt.added[name] = found
        made[name] = Interface(text, idl, descriptions, Origin(source, found))
