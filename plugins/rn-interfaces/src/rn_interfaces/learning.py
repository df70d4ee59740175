"""Learning of interfaces from their texts: dependencies are looked up, rosidl translates and hashes
them, their classes are tried, and each that cannot be used is refused with a reason.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from rn_interfaces.cache import installed
from rn_interfaces.definitions import Outline, by_package, circles, outline
from rn_interfaces.described import described_hashes
from rn_interfaces.found import FoundDefinition, FoundDefinitions, Refusal
from rn_interfaces.generate import describe
from rn_interfaces.sizes import sizes
from rn_interfaces.store import DefinitionStore, Interface, Name, Origin, write
from rn_interfaces.trying import failures
from roboneuron import ConfigurationError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


_RULE = "=" * 80
_NEWEST = ("ROS2_JAZZY", "ROS2_LYRICAL", "ROS2_KILTED", "ROS2_IRON", "ROS2_HUMBLE")
"""Distributions in the order of the search: that of the wheels, then others, newest first."""


@dataclass(kw_only=True, slots=True)
class Learnt:
    """Result of learning, by full name.

    Attributes:
        added: with the hash, also for replaced definitions.
        known: already stored with the same text.
        compiled: packages that are installed, whose compiled types are used.
        refused: with the reason; by file where there is no name.
    """

    added: dict[Name, str] = field(default_factory=dict)
    known: set[Name] = field(default_factory=set)
    compiled: set[str] = field(default_factory=set)
    refused: dict[str, Refusal] = field(default_factory=dict)


def learn(store: DefinitionStore, found: FoundDefinitions) -> Learnt:
    """Keep definitions, and those of rosbags' stores that they need.

    Raises
    ------
    ConfigurationError
        The store cannot take them.
    """
    learnt = Learnt(refused=dict(found.refused))
    lesson = _Lesson(store, learnt)
    for name, text in found.texts.items():
        lesson.take(name, text)
    lesson.complete()
    lesson.measure()
    store.add(lesson.made())
    return learnt


class _Lesson:
    def __init__(self, store: DefinitionStore, learnt: Learnt) -> None:
        self._store = store
        self._learnt = learnt
        self._texts: dict[Name, FoundDefinition] = {}
        self._outlines: dict[Name, Outline] = {}

    def take(self, name: Name, text: FoundDefinition) -> None:
        if installed(name.package, besides=self._store.prefix) is not None:
            self._learnt.compiled.add(name.package)
            return
        self._texts[name] = text
        try:
            self._outlines[name] = outline(name, text.text)
        except ConfigurationError as error:
            self._learnt.refused[str(name)] = Refusal(error.message, error.hint, text.source)

    def complete(self) -> None:
        """Look up dependencies, and refuse interfaces with an unknown one."""
        self._take_dependents()
        waiting = list(self._outlines)
        while waiting:
            name = waiting.pop()
            if name not in self._outlines:
                continue
            for other in sorted(self._outlines[name].used - self._outlines.keys()):
                if self._is_installed(other):
                    continue
                found = self._look_up(other)
                if found is not None:
                    self.take(other, found)
                    waiting.append(other)
                if other not in self._outlines:
                    self._refuse(name, *self._lacking(name, other))
                    break

    def _lacking(self, name: Name, other: Name) -> tuple[str, str]:
        if str(other) in self._learnt.refused:
            return f"{name} uses {other}, which is refused.", ""
        if installed(other.package, besides=self._store.prefix) is not None:
            hint = f"The installed package {other.package} is older or newer than this definition."
        else:
            hint = f"Name the folder of {other.package} as a further SOURCE."
        return f"{name} uses {other}, which is not known.", hint

    def measure(self) -> None:
        """Refuse interfaces that hold themselves or grow too large."""
        used = self._used()
        order = [name for group in by_package(used) for name in group]
        for name, way in circles(used, used.keys() - set(order)):
            held = " -> ".join(map(str, [*way, name]))
            self._refuse(
                name,
                f"{name} holds itself ({held}), so it has no end.",
                "Refer to it by a number or name instead.",
            )
        found = sizes(self._outlines, [name for name in order if name in self._outlines])
        for name, size in found.items():
            if excess := size.excess():
                self._refuse(name, f"{name} {excess}.", "Split it into separate topics.")

    def _used(self) -> dict[Name, frozenset[Name]]:
        return {name: one.used for name, one in self._outlines.items()}

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
                if other in self._texts or name not in self._stored(other):
                    continue
                source = self._store.origin(other).source
                self.take(other, FoundDefinition(self._store.text(other), source))
                changed.add(other)

    def _stored(self, name: Name) -> frozenset[Name]:
        """The messages that a stored interface uses; none if an older version took what this one
        does not.
        """
        try:
            return outline(name, self._store.text(name)).used
        except ConfigurationError:
            return frozenset()

    def _is_installed(self, name: Name) -> bool:
        folder = installed(name.package, besides=self._store.prefix)
        return folder is not None and (folder / name.kind / f"{name.word}.json").is_file()

    def _look_up(self, name: Name) -> FoundDefinition | None:
        if str(name) in self._learnt.refused:
            return None
        if self._store.has(name):
            return FoundDefinition(self._store.text(name), self._store.origin(name).source)
        return known_definition(name)

    def _refuse(self, name: Name, reason: str, instead: str = "") -> None:
        """Refuse an interface and all that use it; no effect on refused ones."""
        waiting = [(name, reason, instead)]
        while waiting:
            one, reason, instead = waiting.pop()
            if one not in self._outlines:
                continue
            del self._outlines[one]
            self._learnt.refused[str(one)] = Refusal(reason, instead, self._texts[one].source)
            waiting += [
                (other, f"{other} uses {one}, which is refused.", "")
                for other, outlined in self._outlines.items()
                if one in outlined.used
            ]

    def made(self) -> dict[Name, Interface]:
        """Interfaces to be stored, with their IDL and description."""
        with TemporaryDirectory() as scratch:
            texts, work = Path(scratch, "texts"), Path(scratch, "work")
            for name in self._outlines:
                write(texts / name.file, self._texts[name].text)
            work.mkdir()
            for names in by_package(self._used()):
                # one by one only if a package has a definition that rosidl refuses
                self._describe(names, texts, work)
            made = dict(self._described(work))
            self._try(Path(scratch, "trials"), made)
        kept = {name: made[name] for name in self._outlines}
        for name, one in kept.items():
            if self._has(name, one):
                self._learnt.known.add(name)
            else:
                self._learnt.added[name] = one.origin.type_hash
        return {name: one for name, one in kept.items() if name in self._learnt.added}

    def _has(self, name: Name, one: Interface) -> bool:
        return (
            self._store.has(name)
            and self._store.text(name) == one.text
            and self._store.description(name) == one.descriptions[name.word]
        )

    def _try(self, folder: Path, made: Mapping[Name, Interface]) -> None:
        """Generate the classes, and refuse those with which Python cannot work."""
        bad: Mapping[Name, str] = {}
        while bad or not folder.exists():
            trial = DefinitionStore(folder / str(len(self._outlines)))
            trial.add({name: made[name] for name in self._outlines})
            bad = failures(trial, [*self._outlines])
            for name, reason in bad.items():
                self._refuse(
                    name,
                    f"Python cannot use the class of {name}: {reason}.",
                    "Give the field or constant another name, or leave out its default value.",
                )

    def _describe(self, names: Iterable[Name], texts: Path, work: Path) -> None:
        left = [name for name in names if name in self._outlines]
        while left:
            error = self._translate(left, texts, work)
            if error is None:
                return
            culprit = next(
                (one for one in left if self._translate([one], texts, work) is not None), left[0]
            )
            self._refuse(
                culprit,
                f"rosidl does not take {culprit}: {error}.",
                "Compare it with a message of ROS 2: `roboneuron ros describe "
                "std_msgs/msg/Header`.",
            )
            left = [name for name in left if name in self._outlines]

    def _translate(self, names: list[Name], texts: Path, work: Path) -> str | None:
        package = names[0].package
        others = {other.package for name in names for other in self._outlines[name].used}
        found = {one: installed(one, besides=self._store.prefix) for one in others}
        includes = {one: folder for one, folder in found.items() if folder is not None}
        listed = [f"{name.kind}/{name.word}" for name in names]
        try:
            with (
                Path(os.devnull).open("w") as nowhere,
                redirect_stdout(nowhere),
                redirect_stderr(nowhere),
            ):
                describe(package, listed, texts, work, includes)
        except Exception as error:  # of lark, empy and the generators, which have no common base
            return " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__
        return None

    def _described(self, work: Path) -> Iterator[tuple[Name, Interface]]:
        for name in list(self._outlines):
            text, source, expected = self._texts[name]
            place = work / name.package / name.kind
            files = [place / f"{name.word}.json", *place.glob(f"{name.word}_*.json")]
            descriptions = {path.stem: path.read_text(encoding="utf-8") for path in files}
            hashes = described_hashes(descriptions[name.word])
            for part, announced in expected.items():
                if announced != hashes.get(part):
                    self._refuse(
                        name,
                        f"{part} of {source} gives {hashes.get(part)}, but the node says "
                        f"{announced}: its definition is not the one that it was built with.",
                        "Build the node again, or learn from the folder that it was built from.",
                    )
                    break
            else:
                idl = (place / f"{name.word}.idl").read_text(encoding="utf-8")
                origin = Origin(source, hashes[str(name)])
                yield name, Interface(text, idl, descriptions, origin)


def known_definition(name: Name) -> FoundDefinition | None:
    """Return the definition of a message from the first distribution that has it; without comments.

    Services and actions are not included.
    """
    for distribution in _NEWEST:
        store = _store(distribution)
        if str(name) in store.types:
            text, _ = store.generate_msgdef(str(name), ros_version=2)
            return FoundDefinition(text.partition(_RULE)[0], f"rosbags, {distribution.lower()}")
    return None


@cache
def _store(distribution: str) -> Typestore:
    from rosbags.typesys import Stores, get_typestore  # heavy

    return get_typestore(Stores[distribution])
