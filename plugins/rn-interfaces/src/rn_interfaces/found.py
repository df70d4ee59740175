"""Definitions found in files, recordings and nodes, and the reasons why others cannot be used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

from rn_interfaces.store import Name


class FoundDefinition(NamedTuple):
    """A found definition.

    Attributes:
        text: content of the file.
        source: place of the definition, such as its file.
        hashes: RIHS01 announced by nodes, for the type or parts such as
            `weld_msgs/srv/Strike_Request`.
    """

    text: str
    source: str
    hashes: Mapping[str, str] = MappingProxyType({})


class Refusal(NamedTuple):
    """Reason why a definition cannot be used.

    Attributes:
        reason: a sentence.
        instead: a sentence that says what to write or do instead; may be empty.
        source: place of the definition, such as its file; may be empty.
    """

    reason: str
    instead: str = ""
    source: str = ""


@dataclass(kw_only=True, slots=True)
class FoundDefinitions:
    """Definitions to be learnt.

    Attributes:
        texts: by full name.
        refused: what cannot be used, by full name, or by file if it has none.
    """

    texts: dict[Name, FoundDefinition] = field(default_factory=dict)
    refused: dict[str, Refusal] = field(default_factory=dict)

    def add(self, name: Name, found: FoundDefinition) -> None:
        """Add a definition; two that say different things are refused both."""
        if str(name) in self.refused:
            return
        other = self.texts.setdefault(name, found)
        if not _is_same(name, other.text, found.text):
            del self.texts[name]
            self.refused[str(name)] = Refusal(
                f"There are two definitions of {name} that differ.",
                "Learn from the one that the robot was built with.",
                other.source if other.source == found.source else f"{other.source}, {found.source}",
            )

    def update(self, others: FoundDefinitions) -> None:
        """Add the content of `others`."""
        self.refused.update(others.refused)
        for name, found in others.texts.items():
            self.add(name, found)


def _is_same(name: Name, one: str, other: str) -> bool:
    if one == other:
        return True
    from rn_interfaces.definitions import says_the_same  # heavy: rosidl

    return says_the_same(name, one, other)
