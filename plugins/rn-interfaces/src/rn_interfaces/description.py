"""The description and hash of a type (REP 2016), as rosidl_generator_type_description writes
them in a file, in the structures of rosidl.
"""

from __future__ import annotations

import ctypes
import json
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from rn_interfaces import structures as c

HASH_PREFIX = "RIHS01_"


class TypeSource(NamedTuple):
    """The text from which a type was made."""

    name: str
    encoding: str
    """`msg`, `srv`, `action`, `idl` or `implicit`."""
    text: str


class TypeDescription:
    """Description, hash and source of one type."""

    def __init__(self, path: Path, source: TypeSource) -> None:
        """`path` is the JSON file of rosidl_generator_type_description."""
        self._facts: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        self._source = source

    @cached_property
    def type_hash(self) -> str:
        """RIHS01 hash, such as `RIHS01_df66...`."""
        names = {one["type_name"]: one["hash_string"] for one in self._facts["type_hashes"]}
        found: str = names[self._facts["type_description_msg"]["type_description"]["type_name"]]
        return found

    def functions(self) -> tuple[int, int, int]:
        """Addresses of the C functions that return hash, description and sources."""
        return self._functions

    @cached_property
    def _functions(self) -> tuple[int, int, int]:
        from rn_interfaces.support import address_of, address_of_function

        value = bytes.fromhex(self.type_hash.removeprefix(HASH_PREFIX))
        described = self._facts["type_description_msg"]
        referenced = [_individual(one) for one in described["referenced_type_descriptions"]]
        source = (c.Source * 1)(c.Source(*map(c.text, self._source)))
        parts = (
            c.TypeHash(1, (ctypes.c_uint8 * 32)(*value)),
            c.Description(
                _individual(described["type_description"]),
                _sequence(c.IndividualDescriptions, c.IndividualDescription, referenced),
            ),
            c.Sources(source, 1, 1),
        )
        hash_at, description_at, sources_at = (
            address_of_function(c.GET, lambda _, place=address_of(part): place) for part in parts
        )
        return hash_at, description_at, sources_at


def _individual(facts: dict[str, Any]) -> c.IndividualDescription:
    fields = [_field(one) for one in facts["fields"]]
    return c.IndividualDescription(
        c.text(facts["type_name"]), _sequence(c.Fields, c.Field, fields)
    )


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
