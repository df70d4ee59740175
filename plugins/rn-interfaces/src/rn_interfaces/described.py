"""Reading of rosidl's JSON descriptions of interfaces, which other programs have written."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from roboneuron import ConfigurationError, ForeignDataError, foreign

_MOST_TYPES = foreign.MOST_TYPE_FIELDS
_HASH = re.compile(r"RIHS01_[0-9a-f]{64}")


def described_hashes(description: bytes | str) -> dict[str, str]:
    """RIHS01 by full name, from a description. Raises ForeignDataError if it is damaged."""
    return foreign.type_hashes(
        foreign.decode_json(description, "it", most_bytes=foreign.MOST_DESCRIPTION_BYTES)
    )


def read_hashes(path: Path) -> dict[str, str]:
    """RIHS01 by full name, from a file. Raises ConfigurationError as `read_facts`."""
    return foreign.type_hashes(read_facts(path))


def read_facts(path: Path) -> dict[str, Any]:
    """The whole description in a file, checked.

    Raises:
        ConfigurationError: it is not there, cannot be read, or is no description.
    """
    try:
        facts = foreign.table(
            foreign.read_json(path, most_bytes=foreign.MOST_DESCRIPTION_BYTES), "it"
        )
        _check(facts)
    except (FileNotFoundError, ForeignDataError) as error:
        reason = error.message if isinstance(error, ForeignDataError) else "it is not there"
        raise ConfigurationError(
            f"{path} is no description of an interface: {reason}.",
            hint="Learn the interface again with `roboneuron ros learn`, or install its package "
            "again.",
        ) from error
    return facts


def used_types(facts: dict[str, Any]) -> list[str]:
    """Full names of all types that a described one uses."""
    described = facts["type_description_msg"]["referenced_type_descriptions"]
    return [one["type_name"] for one in described]


def _check(facts: dict[str, Any]) -> None:
    described = foreign.field(facts, "type_description_msg")
    own = foreign.field(described, "type_description")
    used = foreign.field(described, "referenced_type_descriptions")
    for one in (
        own,
        *foreign.items(used, "referenced_type_descriptions", most=_MOST_TYPES),
    ):
        _check_type(one)
    if not _HASH.fullmatch(foreign.type_hashes(facts).get(own["type_name"], "")):
        raise ForeignDataError(f"the hash of {own['type_name']} is missing or damaged")


def _check_type(described: object) -> None:
    foreign.text(foreign.field(described, "type_name"), "type_name")
    for one in foreign.items(foreign.field(described, "fields"), "fields", most=_MOST_TYPES):
        foreign.text(foreign.field(one, "name"), "name")
        foreign.text(foreign.field(one, "default_value"), "default_value", foreign.MOST_TEXT)
        kind = foreign.field(one, "type")
        foreign.integer(foreign.field(kind, "type_id"), "type_id", 0, 255)
        for name in ("capacity", "string_capacity"):
            foreign.integer(foreign.field(kind, name), name, 0, (1 << 64) - 1)
        foreign.text(foreign.field(kind, "nested_type_name"), "nested_type_name")
