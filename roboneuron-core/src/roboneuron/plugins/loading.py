"""Loading of plugins from their descriptors: import of targets and validation of options; the first
heavy step.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import date, time
from importlib import import_module
from operator import attrgetter
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from roboneuron.errors import (
    ConfigurationError,
    MissingDependencyError,
    PluginError,
    nearest,
    shortened,
)
from roboneuron.plugins import availability
from roboneuron.plugins.specs import Loadable

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError

M = TypeVar("M", bound="BaseModel")
log = logging.getLogger(__name__)
OLD_NAMES_END = "0.2"
"""Release without the present old names of keys; docs/versioning.md says how long they stay."""


def load_target(spec: Loadable) -> object:
    """Import and return the class or function named by `spec.target`.

    Raises:
        MissingDependencyError: a required module is absent; the hint contains the command that
            provides it.
        PluginError: the module cannot be imported or has no such attribute; the cause is kept.
    """
    absent = availability.missing(spec.requires)
    if absent:
        raise MissingDependencyError(
            f"{spec.name!r} needs {', '.join(repr(r.module) for r in absent)}, not installed.",
            hint=f"Run: {availability.install_of(absent)}",
        )
    return load_attribute(spec.target, f"`target` of {spec.name!r}")


def load_attribute(reference: str, who: str) -> object:
    """Import "package.module:attribute"; raises as `load_target`, naming `who`."""
    module_name, _, path = reference.partition(":")
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        absent = error.name or ""
        if absent.partition(".")[0] == module_name.partition(".")[0]:
            raise PluginError(
                f"The {who} is {reference!r}, but there is no module {absent!r}."
            ) from error
        raise MissingDependencyError(
            f"The {who} cannot be imported: there is no module {absent!r}.",
            hint="Install it, and ask the plugin's author to declare it in `requires`.",
        ) from error
    except Exception as error:  # the border to a plugin's own code
        raise PluginError(
            f"Importing the {who} ({reference}) raised {type(error).__name__}: {error}"
        ) from error
    try:
        return attrgetter(path)(module)
    except AttributeError as error:
        absent = error.name or path  # a module that imports names on first use
        raise PluginError(
            f"The {who} is {reference!r}, but there is no attribute {absent!r}.",
            hint=nearest(absent, dir(error.obj)),
        ) from error


def load_options_model(spec: Loadable) -> type[BaseModel] | None:
    """Import the pydantic model of a descriptor's options; None without one. Raises as
    `load_target`.
    """
    if spec.config is None:
        return None
    from pydantic import BaseModel  # heavy

    model = load_attribute(spec.config, f"`config` of {spec.name!r}")
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        raise PluginError(
            f"The `config` of {spec.name!r} ({spec.config}) is {model!r}, expected a pydantic "
            "BaseModel."
        )
    return model


def load_options(
    spec: Loadable,
    options: Mapping[str, object],
    *,
    section: str | None = None,
    is_partial: bool = False,
) -> BaseModel | None:
    """Validate a user's options; return None for a descriptor without options.

    Values are validated like JSON: no text for a number, no number for text; paths may be text,
    tuples may be lists.

    Args:
        spec: descriptor of the plugin or driver.
        options: as in `[plugins.<name>]` of the configuration or as a tool's arguments.
        section: their name in errors; `plugins.<name>` if None.
        is_partial: others may be given later, so missing options and errors of the whole are
            ignored; the result is None then.

    Raises:
        ConfigurationError: an unknown key (names the nearest valid one), a missing one, or a value
            of the wrong type or range; every problem is named.
    """
    place = f"plugins.{spec.name}" if section is None else section
    model = load_options_model(spec)
    if model is None:
        if options:
            raise ConfigurationError(
                f"{place}.{next(iter(options))} is unknown: {spec.name!r} takes no options."
            )
        return None
    made, problems = read_table(model, options, place, is_partial=is_partial)
    if problems:
        raise ConfigurationError(" ".join(problems))
    return made


def read_table(
    model: type[M],
    values: object,
    place: str = "",
    *,
    is_partial: bool = False,
) -> tuple[M | None, list[str]]:
    """Parse a table of a configuration as its model; otherwise return a sentence for each unknown,
    missing or invalid key. An old key is read with a warning.

    Args:
        model: model of the table.
        values: as in the file; validated like JSON, without conversions whatever the model allows.
        place: key of the table; empty for the whole file.
        is_partial: as of `load_options`; for such errors there is neither a model nor a problem.
    """
    from pydantic import ValidationError  # heavy

    valid = [field.alias or name for name, field in model.model_fields.items()]
    if isinstance(values, Mapping):
        values = _with_present_keys(values, old_keys(model), place)
    unknown = [key for key in values if key not in valid] if isinstance(values, Mapping) else []
    if unknown:
        return None, [explain_unknown(f"{place}.{key}".lstrip("."), valid) for key in unknown]
    try:
        return model.model_validate_json(json.dumps(values, default=_plain), strict=True), []
    except ValidationError as error:
        return None, list(_explain(error, model, place, is_partial))


def old_keys(model: type[BaseModel]) -> dict[str, str]:
    """Present key by each old one: those after the first of `validation_alias`, as in
    `Field(validation_alias=AliasChoices("present", "old"))`.
    """
    return {
        old: field.alias or name
        for name, field in model.model_fields.items()
        for old in getattr(field.validation_alias, "choices", ())[1:]
    }


def _with_present_keys(
    values: Mapping[str, object], old: Mapping[str, str], place: str
) -> Mapping[str, object]:
    """The table with present keys; an old key beside its present one is left to be refused."""
    found = {key: now for key, now in old.items() if key in values and now not in values}
    for key, now in found.items():
        log.warning(
            "%s is called %s now; the old name is accepted until %s.",
            f"{place}.{key}".lstrip("."),
            now,
            OLD_NAMES_END,
        )
    return {found.get(key, key): value for key, value in values.items()}


def explain_unknown(key: str, valid: Iterable[str]) -> str:
    """Explain an unknown key, with the most similar valid one.

    Args:
        key: with the tables that contain it.
        valid: keys allowed there.
    """
    known = sorted(valid)
    listed = f"Valid keys: {', '.join(known) or 'none'}."
    return f"unknown key {key!r}. {nearest(key.rpartition('.')[2], known, listed, likeness=0.5)}"


def option_names(model: type[BaseModel], path: Sequence[int | str]) -> list[str]:
    """Fields of the table at `path` below a model (numbers are list indices); empty if there is no
    table.
    """
    table: Any = model
    for part in path:
        if isinstance(part, int):
            continue
        field = table.model_fields.get(part)
        kinds = [] if field is None else [field.annotation, *get_args(field.annotation)]
        kinds += [inner for kind in kinds for inner in get_args(kind)]
        table = next((kind for kind in kinds if hasattr(kind, "model_fields")), None)
        if table is None:
            return []
    return [name for name, field in table.model_fields.items() if not field.exclude]


def _explain(
    error: ValidationError, root: type[BaseModel], place: str, is_partial: bool
) -> Iterator[str]:
    """Yield a sentence for each problem found by the model `root`; see `validated`."""
    for problem in error.errors(include_url=False):
        path = problem["loc"]
        key = ".".join(filter(None, (place, *map(str, path))))
        if is_partial and (not path or (problem["type"] == "missing" and len(path) == 1)):
            continue
        if problem["type"] == "extra_forbidden":
            yield explain_unknown(key, option_names(root, path[:-1]))
        elif problem["type"] == "missing":
            yield f"{key!r} is missing."
        elif problem["type"] == "string_pattern_mismatch":
            yield f"{key} = {shortened(problem['input'])}: {_misspelt(problem)}"
        else:
            words = problem["msg"]
            yield f"{key} = {shortened(problem['input'])}: {words[0].lower()}{words[1:]}."


def _misspelt(problem: Mapping[str, Any]) -> str:
    """Describe the form of a name, with a spelling of the given one that has it if there is one."""
    pattern, given = str(problem["ctx"]["pattern"]), str(problem["input"])[:_LONGEST_NAME]
    form = _FORMS.get(pattern, f"expected the form {pattern}")
    for mark in "-_":
        spelling = re.sub(r"[\s_-]+", mark, given.lower()).strip(mark)
        if re.fullmatch(pattern, spelling):
            return f"{form}. Did you mean {spelling!r}?"
    return f"{form}."


_LONGEST_NAME = 64
_FORMS = {
    r"^[a-z][a-z0-9-]*$": "a name is made of a-z, 0-9 and '-', and begins with a letter",
    r"^[a-z][a-z0-9_]*$": "a name is made of a-z, 0-9 and '_', and begins with a letter",
}
"""What the commonest patterns of names mean."""


def _plain(value: object) -> object:
    """Convert values that JSON lacks but a configuration may contain: paths, dates, read-only
    mappings.
    """
    if isinstance(value, (PurePath, date, time)):  # a datetime is a date
        return str(value)
    if isinstance(value, Mapping):
        return dict(value)
    raise ConfigurationError(
        f"An option is {value!r} ({type(value).__name__}), expected what a TOML file can hold."
    )
