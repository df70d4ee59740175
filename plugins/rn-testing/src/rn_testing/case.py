"""What every case has: a descriptor, options, and how what it describes is built."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Self, TypeVar

from rn_testing.deadline import CALL_LIMITS_S, call_bounded
from rn_testing.fakes import MemoryTopics
from rn_testing.rule import Violation
from roboneuron import DriverSpec, Spec
from roboneuron.command import loading

if TYPE_CHECKING:
    from pydantic import BaseModel

S = TypeVar("S", bound=Spec, covariant=True)


@dataclass(frozen=True, kw_only=True)
class Case(Generic[S]):
    """What every case has.

    Attributes:
        spec: the descriptor under test.
        options: as a user would set them under `[plugins.<name>]`.
        limits_s: bound on one call by method name [s] ("predict", "close"), over those of
            `rn_testing.deadline`; a call that takes longer fails its rule.
        is_automatic: made without the author's help (`roboneuron plugins check` on a plugin without
            `case`): then what cannot be started for want of options, hardware or weights is skipped
            with the reason instead of failing.
    """

    subject: ClassVar[str] = ""
    """First half of the ids of the rules that apply."""

    spec: S
    options: Mapping[str, object] = field(default_factory=dict)
    limits_s: Mapping[str, float] = field(default_factory=dict)
    is_automatic: bool = False

    def configuration(self) -> object:
        """The validated options, or None when the descriptor takes none."""
        return loading.load_options(self.spec, self.options)

    def given_options(self) -> tuple[str, Mapping[str, object]]:
        """The argument of the case that sets options of `option_model`, and these."""
        return "options", self.options

    def option_model(self) -> type[BaseModel] | None:
        """The class of the options that the rules may set."""
        return loading.load_options_model(self.spec)

    def with_options(self, changes: Mapping[str, object]) -> Self:
        """The case with other values of some options."""
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
        """Positional and keyword arguments that `target` is called with, apart from real values."""
        return (None,), {}

    def inputs(self, topics: MemoryTopics) -> tuple[tuple[object, ...], dict[str, object]]:
        """Real positional arguments after the configuration, and keyword arguments."""
        return (), {}

    def option_names(self) -> frozenset[str]:
        """The options that the case sets, which its plugin therefore is to read."""
        return frozenset(self.options)

    def prepare(
        self,
        topics: MemoryTopics | None = None,
        configure: Callable[[object], object] = lambda options: options,
    ) -> Callable[[], Any]:
        """Load target and options and make the arguments; what is returned does nothing but call
        the constructor.

        Args:
            topics: lent to the plugin; new ones when None.
            configure: given the validated options, returns what is passed instead.
        """
        target, configuration = self._target(self.spec), configure(self.configuration())
        positional, named = self.inputs(MemoryTopics() if topics is None else topics)
        return self._bounded(lambda: target(configuration, *positional, **named))
