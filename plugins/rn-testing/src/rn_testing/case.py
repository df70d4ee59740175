"""Base class of cases: a descriptor, its options, and how to build the described object."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Self, TypeVar

from rn_testing.deadline import CALL_LIMITS_S, call_bounded
from rn_testing.fakes import MemoryTopics
from rn_testing.rule import Violation
from roboneuron import DriverSpec, Spec
from roboneuron.feature import loading

if TYPE_CHECKING:
    from pydantic import BaseModel

S = TypeVar("S", bound=Spec, covariant=True)


@dataclass(frozen=True, kw_only=True)
class Case(Generic[S]):
    """Base class of all cases.

    Attributes:
        spec: the descriptor under test.
        options: as a user would set them under `[plugins.<name>]`.
        limits_s: bound on one call by method name [s] ("predict", "close"), overriding those of
            `rn_testing.deadline`; a slower call fails its rule.
        is_automatic: built without the author's help (`roboneuron plugins check` on a plugin
            without `case`): rules that cannot start it for lack of options, hardware or weights are
            skipped with the reason instead of failing.
    """

    subject: ClassVar[str] = ""
    """First half of the ids of the applicable rules."""

    spec: S
    options: Mapping[str, object] = field(default_factory=dict)
    limits_s: Mapping[str, float] = field(default_factory=dict)
    is_automatic: bool = False

    def configuration(self) -> object:
        """The validated options, or None if the descriptor takes none."""
        return loading.load_options(self.spec, self.options)

    def given_options(self) -> tuple[str, Mapping[str, object]]:
        """Name of the case's argument for the options of `option_model`, and its value."""
        return "options", self.options

    def option_model(self) -> type[BaseModel] | None:
        """The class of the options that the rules may set."""
        return loading.load_options_model(self.spec)

    def with_options(self, changes: Mapping[str, object]) -> Self:
        """Return the case with some options changed."""
        return replace(self, options={**self.options, **changes})

    def _target(self, spec: Spec | DriverSpec) -> Callable[..., object]:
        target = loading.load_target(spec)
        if not callable(target):
            raise Violation(f"`target` names {target!r}, expected a class or function")
        return target

    def _bounded(self, construct: Callable[[], object]) -> Callable[[], Any]:
        limit_s = {**CALL_LIMITS_S, **self.limits_s}["constructor"]
        return lambda: call_bounded("the constructor", limit_s, construct)

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """Positional and keyword arguments of `target`, with placeholder values."""
        return (None,), {}

    def inputs(self, topics: MemoryTopics) -> tuple[tuple[object, ...], dict[str, object]]:
        """Real positional arguments after the configuration, and keyword arguments."""
        return (), {}

    def option_names(self) -> frozenset[str]:
        """Options set by the case, which its plugin must therefore read."""
        return frozenset(self.options)

    def prepare(
        self,
        topics: MemoryTopics | None = None,
        configure: Callable[[object], object] = lambda options: options,
    ) -> Callable[[], Any]:
        """Load target and options and build the arguments; the returned function only calls the
        constructor.

        Args:
            topics: topics for the plugin; new ones if None.
            configure: maps the validated options to those that are passed.
        """
        target, configuration = self._target(self.spec), configure(self.configuration())
        positional, named = self.inputs(MemoryTopics() if topics is None else topics)
        return self._bounded(lambda: target(configuration, *positional, **named))
