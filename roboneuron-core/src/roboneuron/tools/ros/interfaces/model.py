"""pydantic models of interfaces, for Python callers and editors with typed attributes.

Only the encoder validates; a model calls it and stores the result, so the two cannot disagree.
Names reserved by Python or pydantic get a trailing underscore as attribute (`from` -> `from_`) but
keep their name in the data.
"""

from __future__ import annotations

import keyword
from collections.abc import Callable, Mapping
from typing import Any

from pydantic import (
    BaseModel,
    ConfigDict,
    ValidatorFunctionWrapHandler,
    create_model,
    model_validator,
)
from pydantic import Field as ModelField
from pydantic_core import PydanticCustomError

from roboneuron.errors import InvalidInputError
from roboneuron.tools.ros.interfaces.description import (
    Array,
    FieldType,
    MessageType,
    Nested,
    Plain,
    Scalar,
)

Canonical = Callable[[MessageType, Mapping[str, object]], dict[str, Plain]]
"""Checks a value and returns all of its fields as plain values. Raises InvalidInputError."""

_TAKEN = frozenset(dir(BaseModel)) | frozenset(BaseModel.__annotations__)


def attribute_name(field: str) -> str:
    """Attribute name of a field on a model: its own name if Python and pydantic allow it."""
    name = field.lstrip("_") or "field"
    if keyword.iskeyword(name) or name in _TAKEN or name != field:
        name += "_"
    return name


def make_model(message: MessageType, canonical: Canonical) -> type[BaseModel]:
    """Return the model class of a message; each nested message type gets one class."""
    return _Maker(canonical).make(message)


class _Maker:
    def __init__(self, canonical: Canonical) -> None:
        self._canonical = canonical
        self._made: dict[int, type[BaseModel]] = {}

    def make(self, message: MessageType) -> type[BaseModel]:
        if id(message) not in self._made:
            self._made[id(message)] = self._make(message)
        return self._made[id(message)]

    def _make(self, message: MessageType) -> type[BaseModel]:
        fields: dict[str, Any] = {}
        for field in message.fields:
            name = attribute_name(field.name)
            while name in fields:
                name += "_"
            annotation = self._annotation(field.type)
            alias, text = field.name, field.text or None
            if field.name in message.required:
                info = ModelField(alias=alias, description=text)
            else:
                default = self._default(field.type, field.default)
                info = ModelField(alias=alias, description=text, default_factory=default)
            fields[name] = (annotation, info)
        canonical = self._canonical

        def check(cls: type[BaseModel], value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
            if isinstance(value, cls):
                return value
            try:
                whole = canonical(message, value)
            except InvalidInputError as error:
                raise PydanticCustomError(
                    "invalid_input", "{reason}", {"reason": str(error)}
                ) from error
            return handler(prune(whole, value))

        model: type[BaseModel] = create_model(
            message.type_name.replace("/", "_"),
            __config__=ConfigDict(extra="forbid", protected_namespaces=(), validate_by_name=False),
            __doc__=message.text or message.type_name,
            __validators__={"_check_whole_value": model_validator(mode="wrap")(classmethod(check))},  # type: ignore[arg-type,dict-item]
            **fields,
        )
        return model

    def _annotation(self, field_type: FieldType) -> object:
        if isinstance(field_type, Array):
            return list[self._annotation(field_type.element)]  # type: ignore[misc]
        if isinstance(field_type, Nested):
            return self.make(field_type.message)
        if field_type.ros == "boolean":
            return bool
        return int if field_type.is_integer else float if field_type.is_float else str

    def _default(self, field_type: FieldType, declared: Plain) -> Callable[[], object]:
        if declared is not None:
            return lambda: list(declared) if isinstance(declared, list) else declared
        if isinstance(field_type, Scalar):
            zero = False if field_type.ros == "boolean" else 0 if field_type.is_integer else 0.0
            return (lambda: "") if field_type.is_text else (lambda: zero)
        if isinstance(field_type, Nested):
            return self.make(field_type.message).model_construct
        if field_type.fixed:
            element = self._default(field_type.element, None)
            return lambda: [element() for _ in range(field_type.size or 0)]
        return list


def prune(whole: Plain, given: object) -> object:
    """Reduce the complete value to the given fields, so that a model knows the omitted ones."""
    if isinstance(whole, dict) and isinstance(given, Mapping):
        return {name: prune(value, given[name]) for name, value in whole.items() if name in given}
    if isinstance(whole, list) and isinstance(given, list | tuple):
        return [prune(value, item) for value, item in zip(whole, given, strict=True)]
    return whole
