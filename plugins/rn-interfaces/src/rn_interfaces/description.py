"""Description and hash of a type (REP 2016) in the structures of rosidl, from files written by
rosidl_generator_type_description.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

from rn_interfaces import structures as c
from rn_interfaces.kept import address_of

HASH_PREFIX = "RIHS01_"


class TypeSource(NamedTuple):
    """Source text of a type."""

    name: str
    encoding: str
    """`msg`, `srv`, `action`, `idl` or `implicit`."""
    text: str


class TypeDescription:
    """Description, hash and sources of one type."""

    def __init__(self, facts: dict[str, Any], sources: Sequence[TypeSource]) -> None:
        """Create it from the output of rosidl_generator_type_description.

        Args:
            facts: content of its JSON file.
            sources: those of the type, and of all types that it uses.
        """
        self._facts = facts
        self._sources = sources

    @cached_property
    def type_hash(self) -> str:
        """RIHS01 hash, such as `RIHS01_df66...`."""
        names = {one["type_name"]: one["hash_string"] for one in self._facts["type_hashes"]}
        found: str = names[self._facts["type_description_msg"]["type_description"]["type_name"]]
        return found

    @cached_property
    def addresses(self) -> tuple[int, int, int]:
        """Addresses of the structures of hash, description and sources."""
        value = bytes.fromhex(self.type_hash.removeprefix(HASH_PREFIX))
        described = self._facts["type_description_msg"]
        referenced = [_individual(one) for one in described["referenced_type_descriptions"]]
        sources = [c.SourceText(*map(c.text, one)) for one in self._sources]
        parts = (
            c.TypeHash(1, (ctypes.c_uint8 * 32)(*value)),
            c.Description(
                _individual(described["type_description"]),
                _sequence(c.IndividualDescriptions, c.IndividualDescription, referenced),
            ),
            _sequence(c.SourceTexts, c.SourceText, sources),
        )
        at_hash, at_description, at_sources = map(address_of, parts)
        return at_hash, at_description, at_sources


def _individual(facts: dict[str, Any]) -> c.IndividualDescription:
    fields = [_field(one) for one in facts["fields"]]
    return c.IndividualDescription(c.text(facts["type_name"]), _sequence(c.Fields, c.Field, fields))


def _field(facts: dict[str, Any]) -> c.Field:
    kind = facts["type"]
    field_type = c.FieldType(
        kind["type_id"],
        kind["capacity"],
        kind["string_capacity"],
        c.text(kind["nested_type_name"]),
    )
    return c.Field(c.text(facts["name"]), field_type, c.text(facts["default_value"]))


def _sequence(cls: type, element: type, values: list[Any]) -> Any:
    array = (element * max(1, len(values)))(*values)  # type: ignore[operator]
    return cls(array, len(values), len(values))
