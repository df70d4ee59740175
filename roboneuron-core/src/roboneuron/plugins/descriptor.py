"""Checks of single descriptors: names, targets and field types, without loading their targets."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from roboneuron.errors import PluginError, shortened
from roboneuron.plugins.specs import (
    COMMAND_SECTIONS,
    VERB_ENDS,
    BackendSpec,
    CommandSpec,
    FeatureSpec,
    Loadable,
    RobotSpec,
    Spec,
)

NAME_PATTERN = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
"""Names of offers and drivers: lower-case letters and digits, single hyphens between them."""
TARGET_PATTERN = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")
"""Format of REFERENCES: "package.module:attribute"."""
REFERENCES = (
    "target",
    "config",
    "case",
    "brings",
    "on_discovery",
    "declared_robot",
    "on_join",
    "module",
    "module_plan",
    "fleet",
    "fleet_config",
)
"""Fields of descriptors that are imported later; all but `target` may be None."""
KEY_PATTERN = re.compile(r"[a-z][a-z0-9_]*")
"""Top-level keys of roboneuron.toml."""
ROBOT_KINDS = ("arm", "base")
"""Values of `RobotSpec.robot_kind`."""


def check_spec(spec: object, expected: type[Spec]) -> Spec:
    """Return `spec` if it is a well-formed descriptor of the class `expected`.

    Args:
        spec: value returned by a hook.
        expected: descriptor class of the hook.

    Raises:
        PluginError: another type, a mutable or wrongly typed field, a malformed name or target.
    """
    kind = expected.kind
    if type(spec) is not expected:
        raise PluginError(f"The hook returned {_describe(spec)}, expected a {expected.__name__}.")
    assert isinstance(spec, Spec)
    who = f"{kind} {spec.name!r}"
    _check_fields(spec, who)
    _check_names(spec, who)
    is_line = bool(spec.summary.strip()) and "\n" not in spec.summary
    _require(is_line, f"The summary of {who} is {spec.summary!r}, expected one line of text.")
    for requirement in spec.requires:
        _require(
            requirement.module.isidentifier(),
            f"{who} requires {requirement.module!r}, expected a top-level module name.",
        )
    if isinstance(spec, RobotSpec):
        _check_robot(spec, who)
    if isinstance(spec, FeatureSpec):
        _check_feature(spec, who)
    if isinstance(spec, BackendSpec):
        _check_verbs(spec, who)
    if isinstance(spec, CommandSpec):
        _check_command(spec, who)
    return spec


def _require(is_right: bool, otherwise: str) -> None:
    """Raise PluginError with the given text unless the condition is true."""
    if not is_right:
        raise PluginError(otherwise)


def _check_names(spec: Loadable, who: str) -> None:
    _require(
        NAME_PATTERN.fullmatch(spec.name) is not None,
        f"The name of {who} is malformed, expected lower-case letters, digits and single hyphens.",
    )
    for name in REFERENCES:
        target = getattr(spec, name, None)
        _require(
            target is None or TARGET_PATTERN.fullmatch(target) is not None,
            f"The `{name}` of {who} is {target!r}, expected 'package.module:attribute'.",
        )


def _check_robot(spec: RobotSpec, who: str) -> None:
    _require(
        spec.robot_kind in ROBOT_KINDS,
        f"The robot_kind of {who} is {spec.robot_kind!r}, expected one of "
        f"{', '.join(ROBOT_KINDS)}.",
    )
    _require(bool(spec.drivers), f"{who} has no drivers, expected at least one DriverSpec.")
    for driver in spec.drivers:
        _check_names(driver, f"driver {driver.name!r} of {who}")
    _check_unique((d.name for d in spec.drivers), f"drivers of {who}")
    _check_unique((c.name for c in spec.cameras), f"cameras of {who}")


def _check_feature(spec: FeatureSpec, who: str) -> None:
    is_whole = bool(spec.module and spec.config and not spec.sections)
    _require(
        not spec.module_kind or (is_whole and KEY_PATTERN.fullmatch(spec.name) is not None),
        f"{who} adds a kind of modules, which needs `module`, one section with a model "
        "(`config`), and a name of lower-case letters and digits.",
    )
    _require(
        not spec.sections or spec.config is not None,
        f"{who} owns {', '.join(spec.sections)} of the configuration, but has no `config`.",
    )
    for key in spec.keys:
        _require(
            KEY_PATTERN.fullmatch(key) is not None,
            f"The section {key!r} of {who} is malformed, expected lower-case letters, digits "
            "and _.",
        )


def _check_verbs(spec: BackendSpec, who: str) -> None:
    for verb in spec.verbs:
        _require(
            verb.achieves in VERB_ENDS,
            f"A verb of {who} achieves {verb.achieves!r}, expected one of {', '.join(VERB_ENDS)}.",
        )
        _require(
            bool(verb.words) and all(word and word == word.lower() for word in verb.words),
            f"A verb of {who} has the words {verb.words!r}, expected lower-case words.",
        )


def _check_command(spec: CommandSpec, who: str) -> None:
    _require(
        not spec.group
        or (
            NAME_PATTERN.fullmatch(spec.group) is not None
            and spec.name.startswith(f"{spec.group}-")
        ),
        f"{who} is in the group {spec.group!r}, so its name has to begin with '{spec.group}-'.",
    )
    _require(
        spec.section in COMMAND_SECTIONS and not (spec.group and spec.section),
        f"The section of {who} is {spec.section!r}, expected one of "
        f"{', '.join(filter(None, COMMAND_SECTIONS))}, or none; a command of a group has none.",
    )
    for name in spec.old_names:
        _require(
            NAME_PATTERN.fullmatch(name) is not None,
            f"The old name {name!r} of {who} is malformed, expected one word.",
        )
    for pair in spec.old_options:
        _require(
            len(pair) == 2 and all(option.startswith("-") for option in pair),
            f"An old option of {who} is {pair!r}, expected a pair as ('--output', '--out').",
        )


def _check_unique(names: Iterable[str], who: str) -> None:
    for name, count in Counter(names).items():
        _require(count == 1, f"The {who} hold the name {name!r} twice.")


def _check_fields(value: object, who: str) -> None:
    kind: Any = type(value)
    hints = _hints_of(kind)
    for field in fields(value):  # type: ignore[arg-type]
        _check_value(getattr(value, field.name), hints[field.name], f"`{field.name}` of {who}")


@cache
def _hints_of(kind: Any) -> dict[str, object]:
    return get_type_hints(kind)


def _check_value(value: object, hint: object, who: str) -> None:
    """Compare one field with its annotation. Only the forms used by descriptors are supported:
    classes, `X | None`, tuples of one type, and dataclasses of these.

    Types are compared exactly: True is not an int here, and a subclass may be mutable.

    Args:
        value: value of the field.
        hint: its annotation.
        who: the field, for messages.

    Raises:
        PluginError: they do not agree.
    """
    if get_origin(hint) in (Union, UnionType):
        if value is None and NoneType in get_args(hint):
            return
        hint = next(a for a in get_args(hint) if a is not NoneType)
    if get_origin(hint) is tuple:
        if type(value) is not tuple:
            raise PluginError(
                f"The {who} is {_describe(value)}, expected a tuple (descriptors are immutable)."
            )
        for item in value:
            _check_value(item, get_args(hint)[0], f"an item of {who}")
        return
    assert isinstance(hint, type)
    accepted: tuple[type, ...] = (int, float) if hint is float else (hint,)
    if type(value) not in accepted:
        raise PluginError(f"The {who} is {_describe(value)}, expected {hint.__name__}.")
    if is_dataclass(hint):
        _check_fields(value, who)


def _describe(value: object) -> str:
    return f"{type(value).__name__} {shortened(value)}"
