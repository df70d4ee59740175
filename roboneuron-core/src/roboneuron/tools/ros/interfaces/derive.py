"""Derivation of the description tree from rosidl's Python classes: types, sizes, constants and
defaults.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosidl_parser import definition as rosidl

from roboneuron.errors import ConfigurationError
from roboneuron.tools.ros.interfaces.choices import assign_choices
from roboneuron.tools.ros.interfaces.comments import NO_COMMENTS, StructComments, read_comments
from roboneuron.tools.ros.interfaces.description import (
    INTEGER_RANGES,
    Array,
    FieldType,
    MessageField,
    MessageType,
    Nested,
    Plain,
    Scalar,
)

_DEFAULT_SUFFIX = "__DEFAULT"
_NANOSECONDS = (0, 999_999_999)
_BASIC = {"boolean", "float", "double", *INTEGER_RANGES}
_ALIASES = {"char": "uint8", "wchar": "uint16"}


@dataclass(slots=True)
class Deriver:
    """Derives and caches descriptions, so that a Header is described once.

    Attributes:
        prefixes: installations whose .idl files contain the comments.
    """

    prefixes: Sequence[Path] = ()
    _messages: dict[type, MessageType] = field(default_factory=dict)
    _comments: dict[tuple[str, str, str], dict[str, StructComments]] = field(default_factory=dict)

    def derive(
        self, ros_type: type, *, nonfinite: frozenset[str] = frozenset(), path: str = ""
    ) -> MessageType:
        """Return the description of a message class.

        Args:
            ros_type: a rosidl message class, or the Request, Goal ... of a service or action.
            nonfinite: dotted field paths (without indices) whose floats may be NaN or infinite; "*"
                for all.
            path: position of this message inside the interface.

        Raises:
            ConfigurationError: a field has a type unsupported by ROS Python.
        """
        inside = frozenset(p for p in nonfinite if p == "*" or not path or p.startswith(path + "."))
        if not inside and ros_type in self._messages:
            return self._messages[ros_type]
        message = self._derive(ros_type, inside, path)
        if not inside:
            self._messages[ros_type] = message
        return message

    def _derive(self, ros_type: type, nonfinite: frozenset[str], path: str) -> MessageType:
        package, kind = ros_type.__module__.split(".")[:2]
        type_name = f"{package}/{kind}/{ros_type.__name__}"
        comments = self._read_comments(package, kind, ros_type.__name__)
        declared = _declared(ros_type)
        defaults = {
            n.removesuffix(_DEFAULT_SUFFIX): v
            for n, v in declared.items()
            if n.endswith(_DEFAULT_SUFFIX)
        }
        constants = {
            n: _to_plain(v) for n, v in declared.items() if not n.endswith(_DEFAULT_SUFFIX)
        }
        names: Sequence[str] = list(ros_type.get_fields_and_field_types())  # type: ignore[attr-defined]
        slots: Sequence[object] = ros_type.SLOT_TYPES  # type: ignore[attr-defined]
        fields = []
        for name, slot in zip(names, slots, strict=True):
            here = f"{path}.{name}" if path else name
            finite = not ({"*", here} & nonfinite)
            field_type = self._field_type(slot, ros_type, type_name, here, nonfinite, finite)
            if type_name.startswith("builtin_interfaces/msg/") and name == "nanosec":
                field_type = Scalar(ros="uint32", lower=_NANOSECONDS[0], upper=_NANOSECONDS[1])
            fields.append(
                MessageField(
                    name=name,
                    type=field_type,
                    default=_to_plain(defaults.get(name.upper())),
                    text=comments.fields.get(name, ""),
                    unit=comments.units.get(name, ""),
                )
            )
        return MessageType(
            type_name=type_name,
            ros_type=ros_type,
            fields=_with_choices(fields, declared),
            constants=tuple(
                (n, v) for n, v in constants.items() if isinstance(v, bool | int | float | str)
            ),
            text=comments.text,
            required=_required(fields, type_name),
        )

    def _field_type(
        self,
        slot: object,
        owner: type,
        owner_name: str,
        path: str,
        nonfinite: frozenset[str],
        finite: bool,
    ) -> FieldType:
        if isinstance(slot, rosidl.AbstractNestedType):
            element = self._field_type(slot.value_type, owner, owner_name, path, nonfinite, finite)
            assert not isinstance(element, Array)
            if isinstance(slot, rosidl.Array):
                return Array(element=element, size=int(slot.size), fixed=True)
            bounded = isinstance(slot, rosidl.BoundedSequence)
            return Array(element=element, size=int(slot.maximum_size) if bounded else None)
        if isinstance(slot, rosidl.NamespacedType):
            return Nested(
                message=self.derive(_find_class(slot, owner), nonfinite=nonfinite, path=path)
            )
        if isinstance(slot, rosidl.AbstractGenericString):
            bound = int(slot.maximum_size) if slot.has_maximum_size() else None
            return Scalar(
                ros="wstring" if isinstance(slot, rosidl.AbstractWString) else "string",
                max_length=bound,
            )
        if isinstance(slot, rosidl.BasicType):
            ros = _ALIASES.get(slot.typename, slot.typename)
            if ros in _BASIC:
                lower, upper = INTEGER_RANGES.get(ros, (None, None))
                return Scalar(ros=ros, lower=lower, upper=upper, finite=finite)
        raise ConfigurationError(
            f"Field {path!r} of {owner_name} has the type {slot!r}, which Python cannot hold."
        )

    def _read_comments(self, package: str, kind: str, struct: str) -> StructComments:
        file = struct if kind == "msg" else struct.partition("_")[0]
        key = (package, kind, file)
        if key not in self._comments:
            self._comments[key] = read_comments(self.prefixes, *key)
        return self._comments[key].get(struct, NO_COMMENTS)


def _declared(ros_type: type) -> Mapping[str, object]:
    """Constants and defaults (`NAME__DEFAULT`) listed by the generated metaclass."""
    return type(ros_type).__prepare__(ros_type.__name__, ())


def _find_class(slot: Any, owner: type) -> type:
    """Return the class of a nested type; parts of services and actions are in their owner's
    module.
    """
    module = importlib.import_module(".".join(slot.namespaces))
    found = getattr(module, slot.name, None) or getattr(
        sys.modules[owner.__module__], slot.name, None
    )
    if found is None:
        found = getattr(importlib.import_module(owner.__module__), slot.name)
    assert isinstance(found, type)
    return found


def _with_choices(
    fields: Sequence[MessageField], declared: Mapping[str, Any]
) -> tuple[MessageField, ...]:
    """Assign constants to fields; octet constants (bytes) only to octet fields."""
    choices = {}
    for octet in (False, True):
        holders = [
            (f.name, f.type)
            for f in fields
            if isinstance(f.type, Scalar) and f.type.is_integer and (f.type.ros == "octet") is octet
        ]
        constants = {
            n: v[0] if isinstance(v, bytes) else v
            for n, v in declared.items()
            if not n.endswith(_DEFAULT_SUFFIX)
            and (isinstance(v, bytes) if octet else isinstance(v, int) and not isinstance(v, bool))
        }
        choices.update(assign_choices(holders, constants))
    return tuple(
        MessageField(
            name=f.name,
            type=f.type,
            default=f.default,
            choices=choices.get(f.name, ()),
            text=f.text,
            unit=f.unit,
        )
        for f in fields
    )


def _required(fields: Sequence[MessageField], type_name: str) -> tuple[str, ...]:
    if (
        len(fields) != 1
        or fields[0].default is not None
        or type_name.endswith(("_Response", "_Result", "_Feedback"))
    ):
        return ()
    only = fields[0]
    stamped = isinstance(only.type, Nested) and only.type.message.is_header
    return () if stamped else (only.name,)


def _to_plain(value: Any) -> Plain:
    """Convert constants and defaults to JSON values: octets to integers, arrays to lists."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, bytes):
        return value[0]
    return [_to_plain(v) for v in (value.tolist() if hasattr(value, "tolist") else value)]
