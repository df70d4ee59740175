"""Check that options are read when the plugin is built, started and used."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rn_testing.attempts import attempt
from rn_testing.cases import Case
from rn_testing.fakes import MemoryTopics
from rn_testing.rule import NotApplicable, require
from roboneuron import Spec

if TYPE_CHECKING:
    from pydantic import BaseModel

OPTIONS_READ = "Each option that the case sets is read, or at least one option; none is changed."
"""Text of the rule `options-read`."""


def check_options_read(
    case: Case[Spec],
    use: Callable[[Callable[[], Any]], None],
    topics: MemoryTopics | None = None,
) -> None:
    """Check that every option set by the case is read when the plugin is built, started and used,
    and at least one of all.

    A model with its own validators may have used options there, so one of its options is enough.
    """
    read: set[str] = set()
    names: set[str] = set()
    judged: set[str] = set()
    kept: list[tuple[BaseModel, object]] = []

    def configure(options: object) -> object:
        if options is None:
            raise NotApplicable("there are no options")
        model: type[BaseModel] = type(options)  # type: ignore[assignment]
        names.update(model.model_fields)
        if not model.__pydantic_decorators__.model_validators:
            judged.update(case.option_names() & names)
        recording = _record_reads(options, read)  # type: ignore[arg-type]
        kept.append((recording, _written(recording)))
        return recording

    build = attempt(case, lambda: case.prepare(topics, configure))
    if not names:
        raise NotApplicable("there are no options")
    use(build)
    changed = [type(options).__name__ for options, before in kept if _written(options) != before]
    require(
        not changed,
        f"the options of {', '.join(changed)} are changed; they belong to the caller",
    )
    ignored = sorted(judged - read)
    require(not ignored, f"the options {', '.join(ignored)} are set and never read")
    require(bool(read), f"none of the options {', '.join(sorted(names))} is read")


def _written(options: BaseModel) -> dict[str, str]:
    """Each option as text; values that a path caches internally do not count as a change."""
    return {name: repr(value) for name, value in options.__dict__.items()}


def _record_reads(options: BaseModel, read: set[str]) -> BaseModel:
    """A copy of `options` that records in `read` which of its fields are accessed."""
    model = type(options)
    names = frozenset(model.model_fields)

    def get(self: object, name: str) -> object:
        if name in names:
            read.add(name)
        elif name.startswith("model_") or name == "__iter__":
            read.update(names)
        return object.__getattribute__(self, name)

    recording = type(
        model.__name__, (model,), {"__getattribute__": get, "__module__": model.__module__}
    )
    copy = options.model_copy()
    object.__setattr__(copy, "__class__", recording)
    return copy
