"""Cases of features, commands and whole packages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, cast

from rn_testing.case import Case
from rn_testing.fakes import MemoryTopics
from roboneuron import CommandSpec, FeatureSpec
from roboneuron.feature import loading

if TYPE_CHECKING:
    from pydantic import BaseModel

    from roboneuron import Feature
    from roboneuron.command import CommandModule


@dataclass(frozen=True, kw_only=True)
class FeatureCase(Case[FeatureSpec]):
    """A feature under test; `options` are its section of roboneuron.toml, or its sections by key if
    it has several.

    Attributes:
        needs: descriptors of the features that it needs.
    """

    subject: ClassVar[str] = "feature"

    needs: tuple[FeatureSpec, ...] = ()

    def sections(self) -> dict[str, object]:
        """The sections as in roboneuron.toml."""
        if not self.options:
            return {}
        return dict(self.options) if self.spec.sections else {self.spec.keys[0]: dict(self.options)}

    def option_model(self) -> type[BaseModel] | None:
        """None: all options of a feature have defaults, which the rule `feature/defaults`
        checks.
        """
        return None

    def options_model(self) -> type[BaseModel] | None:
        """The class of its options."""
        return loading.load_options_model(self.spec)

    def configuration(self) -> object:
        """The validated options, or None if the descriptor takes none."""
        model = self.options_model()
        return None if model is None else model.model_validate(self.options)

    def build(self) -> Feature[Any]:
        """A new feature, not started."""
        return cast("Feature[Any]", self.prepare()())


@dataclass(frozen=True, kw_only=True)
class CommandCase(Case[CommandSpec]):
    """A command under test; it is never run."""

    subject: ClassVar[str] = "command"

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """No arguments, as for the class."""
        return (), {}

    def prepare(
        self,
        topics: MemoryTopics | None = None,
        configure: Callable[[object], object] = lambda options: options,
    ) -> Callable[[], Any]:
        """As in the base class, without arguments."""
        return self._bounded(self._target(self.spec))

    def build(self) -> CommandModule:
        """A new command."""
        return cast("CommandModule", self.prepare()())


@dataclass(frozen=True, kw_only=True)
class PackageCase:
    """An installed distribution under test, or one plugin of a distribution with several.

    Attributes:
        distribution: name of the distribution.
        plugin: entry point name of the plugin; all plugins of the distribution if empty.
        path: search path of the metadata; the interpreter's own path if empty.
    """

    subject: ClassVar[str] = "package"

    distribution: str
    plugin: str = ""
    path: tuple[str, ...] = ()
