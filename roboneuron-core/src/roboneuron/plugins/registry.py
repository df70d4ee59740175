"""Installed plugins and their usability: the immutable result of discovery."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TypeVar, cast

from roboneuron.errors import ConfigurationError, nearest
from roboneuron.plugins.availability import install_command, known_names, new_name, package_of
from roboneuron.plugins.specs import PLUGIN_KINDS, DriverSpec, RobotSpec, Spec

S = TypeVar("S", bound=Spec)
_NEW_NAME = (
    "Write {now!r} in its place, also in [plugins.{now}]; `roboneuron plugins show {now}` has its "
    "options."
)


class Status(StrEnum):
    """Usability, in the order of severity: a plugin has the worst status of its offers."""

    READY = "ready"
    DISABLED = "disabled"
    UNAVAILABLE = "unavailable"
    INCOMPATIBLE = "incompatible"
    CONFLICT = "conflict"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True, slots=True)
class Offer:
    """One descriptor that an installed plugin offers.

    Attributes:
        spec: the descriptor.
        plugin: name of the plugin, that of its entry point.
        distribution: name of its package, which may contain several plugins.
        status: READY if it is usable.
        reason: reason and remedy; empty if ready.
    """

    spec: Spec
    plugin: str
    distribution: str
    status: Status
    reason: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class PluginRecord:
    """One entry point of the group `roboneuron`.

    Attributes:
        name: name of the entry point; by convention the distribution's name if it has one plugin.
        distribution: name of the package.
        version: its version; empty if missing in its metadata.
        module: the plugin module that the entry point names.
        status: the worst of its offers, or FAILED or DISABLED for the whole.
        reason: reason why it is not ready; empty if it is.
        traceback: traceback of its failure; empty otherwise.
        offers: all its offers, in the order of its hooks, unusable ones included.
    """

    name: str
    distribution: str
    version: str
    module: str
    status: Status
    reason: str = ""
    traceback: str = ""
    offers: tuple[Offer, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Registry:
    """All installed plugins and their offers.

    Attributes:
        plugins: one record for each entry point, sorted by name, distribution and module.
        all_offers: every descriptor offered, of any status, sorted by kind, name and plugin.
        kinds: descriptor class by kind, those of installed features included.
    """

    plugins: tuple[PluginRecord, ...]
    all_offers: tuple[Offer, ...]
    kinds: Mapping[str, type[Spec]] = field(default_factory=lambda: PLUGIN_KINDS)
    _ready: dict[str, Mapping[str, Spec]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def offers(self, kind: str) -> tuple[Offer, ...]:
        """All offers of `kind`, unusable ones included; raises ConfigurationError for an unknown
        kind.
        """
        if kind not in self.kinds:
            raise ConfigurationError(
                f"{kind!r} is no kind of plugin, expected one of {', '.join(self.kinds)}.",
                hint=nearest(kind, self.kinds),
            )
        return tuple(o for o in self.all_offers if o.spec.kind == kind)

    def readers_of(self, name: str) -> Iterator[Spec | DriverSpec]:
        """Descriptors that read `[plugins.<name>]`: offers of that name; for a robot, its
        drivers.
        """
        for offer in self.all_offers:
            if offer.spec.name == name:
                yield from (
                    offer.spec.drivers if isinstance(offer.spec, RobotSpec) else (offer.spec,)
                )

    def check_name(self, place: str, name: str) -> None:
        """Check that an installed or deliberately excluded plugin has that name.

        Raises:
            ConfigurationError: begins with `place`.
        """
        installed = {offer.spec.name for offer in self.all_offers}
        known = known_names()
        package = known.get(name)
        if name in installed or (package is not None and self.not_loaded(package)):
            return
        if package is not None:
            raise ConfigurationError(
                f"{place}: {name!r} is not installed. Run: {install_command(package)}."
            )
        now = new_name(name)
        if now:
            raise ConfigurationError(
                f"{place}: {name!r} is called {now!r} now.", hint=_NEW_NAME.format(now=now)
            )
        robots = [
            f"[plugins.{offer.spec.name}]"
            for offer in self.all_offers
            if isinstance(offer.spec, RobotSpec) and name in {d.name for d in offer.spec.drivers}
        ]
        if robots:
            raise ConfigurationError(
                f"{place}: {name!r} is a driver; its options belong to its robot: "
                f"{', '.join(sorted(robots))}."
            )
        meant = nearest(name, {*installed, *known})
        if meant or not self.not_loaded():  # otherwise one that did not load may have that name
            listed = ", ".join(sorted(installed)) or "none"
            raise ConfigurationError(
                f"{place}: nothing is called {name!r}. {meant or f'Installed are: {listed}.'}"
            )

    def specs(self, of: type[S]) -> Mapping[str, S]:
        """The usable descriptors of a class by name, sorted; raises ConfigurationError for a class
        without a hook. `kinds` has the class of each kind.
        """
        ready = self._ready.get(of.kind)
        if ready is None:  # cached: answers to calls need it, and there are hundreds of offers
            ready = {o.spec.name: o.spec for o in self.offers(of.kind) if o.status is Status.READY}
            self._ready[of.kind] = ready
        return cast("Mapping[str, S]", ready)

    def get(self, of: type[S], name: str, *, elsewhere: bool = False) -> S:
        """The usable descriptor of that class and name; `elsewhere`: modules that it needs may be
        absent here, because it runs under another interpreter.

        Raises:
            ConfigurationError: there is none; names the reason (disabled, unavailable, failed,
                unknown), the choices and a remedy.
        """
        kind, ready = of.kind, self.specs(of)
        if name in ready:
            return ready[name]
        claims = [o for o in self.offers(kind) if o.spec.name == name]
        if elsewhere and [o.status for o in claims] == [Status.UNAVAILABLE]:
            return cast("S", claims[0].spec)
        if claims:
            reasons = " ".join(dict.fromkeys(f"{o.status}: {o.reason}" for o in claims))
            raise ConfigurationError(
                f"The {kind} {name!r} cannot be used ({', '.join(o.plugin for o in claims)} "
                f"{reasons}).",
                hint=_choices(kind, ready),
            )
        now = new_name(name)
        if now:
            raise ConfigurationError(
                f"The {kind} {name!r} is called {now!r} now.", hint=_NEW_NAME.format(now=now)
            )
        package = package_of(kind, name)
        silent = package is not None and self.not_loaded(package)
        if package is not None and not silent:
            raise ConfigurationError(
                f"There is no {kind} {name!r} installed; the package {package.partition('[')[0]} "
                "brings it.",
                hint=f"Run: {install_command(package)}. "
                f"{_choices(kind, ready)}{self._explain_absent_plugins()}",
            )
        raise ConfigurationError(
            f"There is no {kind} {name!r}. {'' if silent else nearest(name, ready)}".rstrip(),
            hint=f"{_choices(kind, ready)}{self._explain_absent_plugins()}",
        )

    def not_loaded(self, package: str = "") -> str:
        """Plugins (of a package) whose offers are unknown, because they are disabled or failed, as
        text: "rn-x (failed)".

        One of them may offer a missing name; empty if all were loaded.
        """
        silent = [p for p in self.plugins if p.status in (Status.DISABLED, Status.FAILED)]
        of = package.partition("[")[0]
        return ", ".join(f"{p.name} ({p.status})" for p in silent if not of or p.distribution == of)

    def _explain_absent_plugins(self) -> str:
        silent = self.not_loaded()
        return f" Not loaded: {silent}; see `roboneuron plugins list`." if silent else ""


def _choices(kind: str, ready: Mapping[str, Spec]) -> str:
    return (
        f"Choose one of: {', '.join(ready)}."
        if ready
        else f"No {kind} plugin is ready; see `roboneuron plugins list`."
    )
