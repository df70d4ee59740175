"""Plugin options that an agent may not set: those for hosts, files, commands or environment
variables.

They are marked in the options model of the plugin, see `roboneuron.plugins.specs`; an option
without a mark is classified by its type and name.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from datetime import time as clock_time
from enum import Enum
from pathlib import PurePath
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Literal, TypeGuard, Union, get_args, get_origin

from roboneuron.plugins.loading import old_keys
from roboneuron.plugins.option_marks import AgentMaySet, ConfigurationOnly

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

__all__ = ["OptionAccess", "restricted_values"]
"""Names that other distributions may use."""

_WORDS = re.compile(
    r"(?:^|[_\W])(?:address(?:es)?|arg(?:ument)?|cert(?:ificate)?|command|credential|dir(?:ectory|ectories)?|env"
    r"|environment|executable|file|folder|host(?:name)?|interpreter|key|password|path|program|python|script|secret"
    r"|server|shell|socket|token|ur[il]|variable)s?(?:$|[_\W])"
)
"""Words in an option's name that indicate the name of a host, a file, a command or a secret."""
_ADDRESS = re.compile(
    r"(?:^|[_\W])(?:address|end_?point|host(?:name)?|server|socket|ur[il])s?(?:e?s)?(?:$|[_\W])"
)
"""Words in an option's name that indicate an address; a value with a scheme, such as ws://, counts
too.
"""
_PLAIN = (bool, int, float, str)


@dataclass(frozen=True, kw_only=True, slots=True)
class OptionAccess:
    """Who may set an option.

    Attributes:
        mark: that of the option; None without one. Of several, the one that restricts it.
        looks_restricted: text in it may name a host, a file, a command or a secret, by its type and
            name.
    """

    mark: ConfigurationOnly | AgentMaySet | None
    looks_restricted: bool

    @classmethod
    def of(cls, name: str, field: FieldInfo) -> OptionAccess:
        """The access to a field of an options model."""
        marks = [
            mark
            for mark in (*field.metadata, *_inner_marks(field.annotation))
            if isinstance(mark, ConfigurationOnly | AgentMaySet)
        ]
        kinds = set(_kinds(field.annotation))
        is_named = "text" in kinds and _WORDS.search(name.lower()) is not None
        return cls(
            mark=min(marks, key=lambda mark: isinstance(mark, AgentMaySet), default=None),
            looks_restricted=bool(kinds & {"place", "opaque"}) or is_named,
        )

    @property
    def is_restricted(self) -> bool:
        """True if only the configuration may set it: by its mark, or else by its type and name."""
        return (
            self.looks_restricted if self.mark is None else isinstance(self.mark, ConfigurationOnly)
        )


def restricted_values(
    model: type[BaseModel] | None, options: Mapping[str, object]
) -> dict[str, object]:
    """Values in `options` that only the configuration may set, by dotted name; all of them without
    a model.
    """
    return dict(options) if model is None else dict(_in_table([model], options, ""))


def unnamed_addresses(
    model: type[BaseModel], options: Mapping[str, object], place: str = ""
) -> Iterator[str]:
    """Dotted names of options with an address as default that are not set in `options`."""
    old = old_keys(model)
    given = {*options, *(old[key] for key in options if key in old)}
    for name, field in model.model_fields.items():
        if (
            not {name, field.alias} & given
            and not field.is_required()
            and OptionAccess.of(name, field).is_restricted
        ):
            found = field.get_default(call_default_factory=True)
            if any(
                _is_address(name, value)
                for value in (found if isinstance(found, list | tuple) else [found])
            ):
                yield f"{place}{name}"
        for kind in _alternatives(field.annotation):
            inner = options.get(name, options.get(field.alias or name, {}))
            if _is_model(kind) and isinstance(inner, Mapping):
                yield from unnamed_addresses(kind, inner, f"{place}{name}.")


def _is_address(name: str, value: object) -> bool:
    return (
        isinstance(value, str)
        and value != ""
        and (_ADDRESS.search(name.lower()) is not None or "://" in value)
    )


def _inner_marks(annotation: object) -> Iterator[object]:
    """Marks inside a type, as in `Annotated[Path, ConfigurationOnly()] | None`."""
    yield from getattr(annotation, "__metadata__", ())
    for part in get_args(annotation):
        yield from _inner_marks(part)


def _kinds(annotation: object) -> Iterator[str]:
    """Possible contents of a value of that type: "place" (a path, an address), "text", or "opaque"
    (anything).
    """
    annotation = getattr(annotation, "__value__", annotation)  # a `type` statement of Python 3.12
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Literal or annotation in (None, ...):
        return
    if origin is Annotated:
        yield from _kinds(parts[0])
    elif origin is not None:
        for part in parts:
            yield from _kinds(part)
    elif not isinstance(annotation, type):
        yield "opaque"
    elif issubclass(annotation, PurePath) or annotation.__module__ in (
        "ipaddress",
        "pydantic.networks",
    ):
        yield "place"
    elif issubclass(
        annotation, (bool, int, float, complex, Enum, type(None), date, clock_time, timedelta)
    ):
        return
    elif not _is_model(annotation):  # a table is checked option by option
        yield "text" if issubclass(annotation, (str, bytes)) else "opaque"


def _alternatives(annotation: object) -> Iterator[object]:
    """The possible types of a value: the parts of a union, without annotations."""
    annotation = getattr(annotation, "__value__", annotation)
    if get_origin(annotation) is Annotated:
        yield from _alternatives(get_args(annotation)[0])
    elif get_origin(annotation) in (Union, UnionType):
        for part in get_args(annotation):
            yield from _alternatives(part)
    else:
        yield annotation


def _is_model(kind: object) -> TypeGuard[type[BaseModel]]:
    from pydantic import BaseModel

    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _in_table(
    models: Sequence[type[BaseModel]], options: Mapping[str, object], place: str
) -> Iterator[tuple[str, object]]:
    """Restricted values of a table that one of `models` reads; a key unknown to all of them counts
    as restricted.
    """
    known = [entry for model in models for entry in model.model_fields.items()]
    for key, value in options.items():
        fields = [(name, field) for name, field in known if key in (name, field.alias)]
        if not fields or any(OptionAccess.of(name, field).is_restricted for name, field in fields):
            yield f"{place}{key}", value
        else:
            yield from _in_value([field.annotation for _, field in fields], value, f"{place}{key}")


def _in_value(
    annotations: Sequence[object], value: object, place: str
) -> Iterator[tuple[str, object]]:
    """Restricted values of a value with one of the types: a table, a table of tables, a list of
    tables, or none of these.
    """
    kinds = [kind for annotation in annotations for kind in _alternatives(annotation)]
    models = [kind for kind in kinds if _is_model(kind)]
    parts = [part for kind in kinds for part in get_args(kind)]
    if isinstance(value, Mapping):
        if models:
            yield from _in_table(models, value, f"{place}.")
        for key, inner in value.items() if parts else ():
            yield from _in_value(parts, inner, f"{place}.{key}")
    elif isinstance(value, (list, tuple)):
        for index, inner in enumerate(value) if parts else ():
            yield from _in_value(parts, inner, f"{place}.{index}")
    elif models and value is not None and not any(kind in _PLAIN for kind in kinds):
        yield place, value  # only the plugin knows the type of that table
