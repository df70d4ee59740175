"""Discovery of plugins: every entry point of the group `roboneuron`, isolated from each other.

An error of one plugin is written into its record and does not affect the others.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
import traceback
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from functools import lru_cache
from importlib.metadata import Distribution, EntryPoint, entry_points
from types import ModuleType
from typing import Protocol, cast

from roboneuron.errors import ConfigurationError, PluginError, RoboNeuronError, nearest
from roboneuron.plugins import availability
from roboneuron.plugins.descriptor import check_spec
from roboneuron.plugins.hookspecs import HOOKS, PROJECT, extended
from roboneuron.plugins.loading import load_attribute
from roboneuron.plugins.registry import Offer, PluginRecord, Registry, Status
from roboneuron.plugins.specs import (
    CONTRACT_VERSION,
    CommandSpec,
    FeatureSpec,
    RobotSpec,
    Spec,
)

_DECLARED = "declared-arm"
"""Feature to install when a configuration declares an arm and none describes it."""
_HOOK_PREFIX = f"{PROJECT}_"
_BRINGING = {hook: spec for hook, spec in HOOKS.items() if spec in (FeatureSpec, CommandSpec)}
"""Hooks whose descriptors may define other kinds."""
_MARK = f"{PROJECT}_impl"
"""Attribute that `pluggy.HookimplMarker` sets on a decorated function."""
_SPEC_MARK = f"{PROJECT}_spec"
"""Attribute that `pluggy.HookspecMarker` sets: a feature may define its hooks in its plugin
module.
"""


class RobotDeclaration(Protocol):
    """`[robot]` of a configuration."""

    @property
    def name(self) -> str: ...

    @property
    def arm(self) -> object | None: ...


def discover(
    disabled: Collection[str] = (),
    robot: RobotDeclaration | None = None,
    *,
    points: Iterable[EntryPoint] | None = None,
) -> Registry:
    """Read all installed plugins, importing only their plugin modules.

    Two passes: plugins may define additional kinds and hooks, which are collected before any
    plugin's offers are read.

    Args:
        disabled: names of plugins that must not be imported; a distribution's name stands for all
            of its plugins.
        robot: section of the configuration; if it declares an arm, that is among the robots.
        points: entry points of the group `roboneuron`, in any order; those installed if None.

    Raises:
        ConfigurationError: `disabled` names neither an installed plugin nor a distribution with
            plugins; no feature describes the arm, or an installed robot has its name.
    """
    registry = (
        _discover_in(_search_path(), tuple(disabled))
        if points is None
        else _discover_from(points, disabled)
    )
    return registry if robot is None or robot.arm is None else _with_declared(registry, robot)


def _with_declared(registry: Registry, robot: RobotDeclaration) -> Registry:
    """The plugins, and the robot that a configuration declares, as an offer of the feature that
    describes it.
    """
    offered = next((o for o in registry.offers("robot") if o.spec.name == robot.name), None)
    if offered is not None:
        raise ConfigurationError(
            f"[robot.arm] declares {robot.name!r}, which {offered.plugin} offers as well.",
            hint="Give it another name, or leave [robot.arm] out.",
        )
    features = registry.specs(FeatureSpec)
    maker = next((name for name, feature in features.items() if feature.declared_robot), _DECLARED)
    feature = registry.get(FeatureSpec, maker)
    describe = load_attribute(
        feature.declared_robot or "", f"`declared_robot` of feature {maker!r}"
    )
    spec = check_spec(cast("Callable[[object], object]", describe)(robot), RobotSpec)
    by = next(offer for offer in registry.offers("feature") if offer.spec is feature)
    mine = replace(by, spec=replace(cast("RobotSpec", spec), declaration=robot))
    return replace(registry, all_offers=(*registry.all_offers, mine))


@lru_cache(maxsize=1)
def _discover_in(path: tuple[tuple[str, int], ...], disabled: tuple[str, ...]) -> Registry:
    """Cached until a folder changes: a start calls this twice before its first answer, and a server
    with each start of a module.
    """
    importlib.invalidate_caches()
    return _discover_from(entry_points(group=PROJECT), disabled)


def _search_path() -> tuple[tuple[str, int], ...]:
    """Folders of the import path, with the time of their last change [ns]."""
    found = []
    for entry in sys.path:
        try:
            found.append((entry, os.stat(entry or ".").st_mtime_ns))
        except OSError:
            found.append((entry, 0))
    return tuple(found)


def _discover_from(points: Iterable[EntryPoint], disabled: Collection[str]) -> Registry:
    found = sorted(((_record(point), point) for point in points), key=lambda pair: _order(pair[0]))
    skipped = _check_disabled(disabled, {name for record, _ in found for name in _names(record)})
    hooks = HOOKS
    records: list[PluginRecord] = []
    waiting: list[tuple[PluginRecord, EntryPoint]] = []
    for record, point in found:
        if not skipped.isdisjoint(map(_normalise, _names(record))):
            records.append(
                replace(record, status=Status.DISABLED, reason="Disabled by the configuration.")
            )
            continue
        try:
            with redirect_stdout(sys.stderr):
                hooks = extended(hooks, _offered(point.load(), _BRINGING))
        except (Exception, SystemExit) as error:
            records.append(_failed(record, error))
        else:
            waiting.append((record, point))
    records += [_examine(record, point, hooks) for record, point in waiting]
    return _settle(sorted(records, key=_order), hooks)


def _order(record: PluginRecord) -> tuple[str, str, str]:
    return record.name, record.distribution, record.module


def _names(record: PluginRecord) -> tuple[str, str]:
    """Names of it in `disabled_plugins`."""
    return record.name, record.distribution


def _record(point: EntryPoint) -> PluginRecord:
    """Create the record of a plugin that is ready and has no offers; its module is not imported."""
    distribution, version = (point.name, "") if point.dist is None else _named(point.dist)
    return PluginRecord(
        name=point.name,
        distribution=distribution,
        version=version,
        module=point.module,
        status=Status.READY,
    )


@lru_cache
def _named(found: Distribution) -> tuple[str, str]:
    """Name and version of a distribution, cached per object (shared by its entry points), because
    each access reads a file.
    """
    metadata = found.metadata
    return metadata["Name"], metadata["Version"] or ""


def _normalise(name: str) -> str:
    """Normalise a project name by PEP 503: "RN_Standard" and "rn-standard" are equal."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _check_disabled(disabled: Collection[str], installed: Collection[str]) -> set[str]:
    """Return the disabled names, normalised.

    Raises:
        ConfigurationError: one is not installed; otherwise a misspelt plugin would be loaded.
    """
    known = {_normalise(name) for name in installed}
    wanted = {_normalise(name): name for name in disabled}
    for normal, name in wanted.items():
        if normal not in known:
            raise ConfigurationError(
                f"The disabled plugin {name!r} is not installed.",
                hint=nearest(normal, known, f"Installed: {', '.join(sorted(known)) or 'none'}."),
            )
    return set(wanted)


def _failed(record: PluginRecord, error: BaseException) -> PluginRecord:
    where = f"Importing {record.module} raised {type(error).__name__}: {error}"
    return replace(
        record,
        status=Status.FAILED,
        reason=str(error) if isinstance(error, RoboNeuronError) else where,
        traceback="".join(traceback.format_exception(error)),
    )


def _examine(
    record: PluginRecord, point: EntryPoint, hooks: Mapping[str, type[Spec]]
) -> PluginRecord:
    """Import one plugin and call its hooks; every failure is stored in its record.

    Its output goes to stderr: stdout may be the wire of an agent. A plugin that raises SystemExit
    counts as failed.
    """
    try:
        with redirect_stdout(sys.stderr):
            specs = read_module(point.load(), hooks)
            offers = tuple(_offer(spec, record) for spec in specs)
            _tell_discovered(offers)
    except (Exception, SystemExit) as error:
        return _failed(record, error)
    return replace(record, offers=offers)


def _tell_discovered(offers: Iterable[Offer]) -> None:
    for offer in offers:
        function = getattr(offer.spec, "on_discovery", None)
        if function is not None and offer.status is Status.READY:
            found = load_attribute(function, f"`on_discovery` of feature {offer.spec.name!r}")
            if not callable(found):
                raise PluginError(f"{function} is {found!r}, expected a function.")
            found()


def read_module(module: object, hooks: Mapping[str, type[Spec]] = HOOKS) -> tuple[Spec, ...]:
    """Return the descriptors of a plugin module, in the order of the hooks.

    Raises:
        PluginError: the module misspells a hook, forgets its decorator, or offers nothing, or a
            hook raises or does not return a sequence of well-formed descriptors.
    """
    if not isinstance(module, ModuleType):
        raise PluginError(
            f"The entry point names {type(module).__name__} {module!r}, expected a module."
        )
    _check_hook_names(module, tuple(hooks))
    specs = _offered(module, hooks)
    if not specs:
        raise PluginError(
            f"{module.__name__} offers nothing, expected a hook such as {next(iter(hooks))}."
        )
    return tuple(specs)


def _check_hook_names(module: ModuleType, hooks: Sequence[str]) -> None:
    """Check that every function with the hooks' prefix is a hook and is decorated."""
    for name, value in vars(module).items():
        marked = getattr(value, _MARK, None) is not None
        if not (callable(value) and (marked or name.startswith(_HOOK_PREFIX))) or hasattr(
            value, _SPEC_MARK
        ):
            continue
        if name not in hooks:
            raise PluginError(
                f"{module.__name__}.{name} is no hook. {nearest(name, hooks, likeness=0.0)}"
            )
        if not marked:
            raise PluginError(
                f"{module.__name__}.{name} is not decorated, expected @hookimpl from "
                "roboneuron.plugins.hookspecs."
            )


def _offered(module: object, hooks: Mapping[str, type[Spec]]) -> list[Spec]:
    """Return the descriptors of some hooks; raises as `read_module`."""
    return [
        check_spec(spec, expected)
        for hook, expected in hooks.items()
        for spec in _call(module, hook)
    ]


def _call(module: object, hook: str) -> Sequence[object]:
    """Call a hook of a module; empty if the module does not implement it (it defines its
    specification, or has no such name).

    Raises:
        PluginError: the hook raises, or does not return a sequence.
    """
    function = getattr(module, hook, None)
    if function is None or not hasattr(function, _MARK):
        return ()
    try:
        offered = function()
    except (Exception, SystemExit) as error:
        raise PluginError(f"The hook {hook} raised {type(error).__name__}: {error}") from error
    if not isinstance(offered, (list, tuple)):
        what = "None" if offered is None else type(offered).__name__
        raise PluginError(f"The hook {hook} returned {what}, expected a sequence of descriptors.")
    return offered


def _offer(spec: Spec, record: PluginRecord) -> Offer:
    """Create an offer with its status, as far as it depends on this plugin only.

    Args:
        spec: checked descriptor.
        record: record of the plugin.

    Returns:
        INCOMPATIBLE takes precedence over UNAVAILABLE: installing something does not help a plugin
        that was written for another contract.
    """
    status, reason = Status.READY, ""
    if spec.contract != CONTRACT_VERSION:
        older = record.distribution if spec.contract < CONTRACT_VERSION else "roboneuron-core"
        status = Status.INCOMPATIBLE
        reason = (
            f"Written for contract {spec.contract}, this core has {CONTRACT_VERSION}; upgrade "
            f"{older}."
        )
    elif absent := availability.missing(spec.requires):
        status, reason = Status.UNAVAILABLE, availability.explain(absent)
    return Offer(
        spec=spec,
        plugin=record.name,
        distribution=record.distribution,
        status=status,
        reason=reason,
    )


def _settle(records: Sequence[PluginRecord], hooks: Mapping[str, type[Spec]]) -> Registry:
    """Mark claims on the same name as conflicts, and set each plugin's status to the worst of its
    offers.
    """
    claims: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
    for record in records:
        for offer in record.offers:
            of = "" if offer.plugin == offer.distribution else f" of {offer.distribution}"
            for claim in _claimed(offer.spec):
                claims[claim].append(f"{offer.plugin}{of}")
    settled = tuple(
        _summarise(record, tuple(_contest(o, claims) for o in record.offers)) for record in records
    )
    offers = [offer for record in settled for offer in record.offers]
    offers.sort(key=lambda o: (o.spec.kind, o.spec.name, o.plugin, o.distribution))
    return Registry(
        plugins=settled,
        all_offers=tuple(offers),
        kinds={spec.kind: spec for spec in hooks.values()},
    )


def _claimed(spec: Spec) -> list[tuple[str, str]]:
    """Claims that only one plugin may have: the name within its kind, and the sections of a
    feature.
    """
    sections = spec.keys if isinstance(spec, FeatureSpec) else ()
    return [(spec.kind, spec.name), *(("section", key) for key in sections)]


def _contest(offer: Offer, claims: Mapping[tuple[str, str], Sequence[str]]) -> Offer:
    """Return the offer, as a conflict if another plugin has the same claim.

    None of them wins: the choice of a plugin that moves a robot must not depend on an order.
    """
    for kind, name in _claimed(offer.spec):
        claimants = claims[kind, name]
        if len(claimants) > 1:
            return replace(
                offer,
                status=Status.CONFLICT,
                reason=f"The {kind} {name!r} is claimed by {' and by '.join(claimants)}; uninstall "
                "or disable all but one.",
            )
    return offer


def _summarise(record: PluginRecord, offers: tuple[Offer, ...]) -> PluginRecord:
    """Return the record with its offers, the worst of their statuses and all their reasons."""
    # in the order of the enumeration, the best first
    worst = max((o.status for o in offers), key=list(Status).index, default=record.status)
    reasons = dict.fromkeys(f"{o.spec.kind} {o.spec.name}: {o.reason}" for o in offers if o.reason)
    return replace(record, status=worst, reason=" ".join(reasons) or record.reason, offers=offers)
