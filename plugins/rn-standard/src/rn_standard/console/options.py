"""Options of a pydantic model as text, for `roboneuron config show`, `config reference` and
`plugins show`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import TYPE_CHECKING, get_args, get_origin

from roboneuron.selection.restricted import OptionAccess

if TYPE_CHECKING:
    from pydantic import BaseModel

UNSET = "none"
"""Default of an optional option without a value."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Option:
    """One key.

    Attributes:
        key: as in the configuration.
        type: with its bounds or choices.
        default: as in TOML, or UNSET; None if required.
        meaning: its description.
        restricted: only the configuration may set it.
    """

    key: str
    type: str
    default: str | None
    meaning: str
    restricted: bool = False


def describe_options(model: type[BaseModel]) -> Iterator[Option]:
    """Yield the options of a model, in its order; inherited ones are last.

    Those of a table follow it, as `table.key`; in a table of tables as `table.<name>.key`, in a
    list as `list[].key`.
    """
    fields = model.model_fields
    own = [fields[name].alias or name for name in model.__annotations__ if name in fields]
    properties = model.model_json_schema().get("properties", {})
    for key, entry in sorted(
        properties.items(), key=lambda item: own.index(item[0]) if item[0] in own else len(own)
    ):
        field = next(f for name, f in fields.items() if key in (name, f.alias))
        default = (
            None if field.is_required() else _literal(field.get_default(call_default_factory=True))
        )
        restricted = OptionAccess.of(key, field).is_restricted
        meaning = entry.get("description", "")
        yield Option(
            key=key, type=_type(entry), default=default, meaning=meaning, restricted=restricted
        )
        for place, table in _tables(key, field.annotation):
            for option in describe_options(table):
                yield replace(option, key=f"{place}.{option.key}")


def _tables(place: str, annotation: object) -> Iterator[tuple[str, type[BaseModel]]]:
    from pydantic import BaseModel

    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield place, annotation
        return
    origin = get_origin(annotation)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        place = f"{place}.<name>"
    elif isinstance(origin, type) and issubclass(origin, Sequence):
        place = f"{place}[]"
    for part in get_args(annotation):
        yield from _tables(place, part)


def _literal(value: object) -> str:
    """Format a value as in TOML; unset values in a table are left out."""
    if value is None:
        return UNSET
    if isinstance(value, bool | int | float):
        return str(value).lower()
    if isinstance(value, str | PurePath):
        return json.dumps(str(value), ensure_ascii=False)
    if hasattr(value, "model_dump"):
        value = value.model_dump(mode="json")
    if isinstance(value, Mapping):
        entries = [
            f"{json.dumps(str(key))} = {_literal(item)}"
            for key, item in value.items()
            if item is not None
        ]
        return f"{{ {', '.join(entries)} }}" if entries else "{}"
    return f"[{', '.join(_literal(item) for item in value)}]"  # type: ignore[attr-defined]


def _type(entry: dict[str, object]) -> str:
    if "anyOf" in entry:
        alternatives = [a for a in entry["anyOf"] if a.get("type") != "null"]  # type: ignore[attr-defined]
        return " or ".join(dict.fromkeys(_type(alternative) for alternative in alternatives))
    if "const" in entry:
        return f"`{entry['const']}`"
    if "enum" in entry:
        return " or ".join(f"`{value}`" for value in entry["enum"])  # type: ignore[attr-defined]
    bounds = []
    if "exclusiveMinimum" in entry:
        bounds.append(f"> {entry['exclusiveMinimum']:g}")
    if "minimum" in entry:
        bounds.append(f"≥ {entry['minimum']:g}")
    if "maximum" in entry:
        bounds.append(f"≤ {entry['maximum']:g}")
    words = {"array": "list", "object": "table", "value": "table"}
    kind = str(entry.get("type", "value"))
    return " ".join([words.get(kind, kind), ", ".join(bounds)]).strip()
