"""Exposed endpoints: those of robot profiles and of the configuration, checked, with tightened
limits.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from roboneuron.config.models import Config
from roboneuron.contract import Endpoint, Obstacle, RobotProfile
from roboneuron.direct_path.exposed import (
    Use,
    by_topic,
    check_reserved,
    check_stop,
    profile_endpoints,
    same_for_each_topic,
    tightened_by,
)
from roboneuron.direct_path.interface_class import UnusableTypeError
from roboneuron.direct_path.joint_messages import JOINT_TYPES
from roboneuron.direct_path.limits import check_endpoint
from roboneuron.errors import ConfigurationError, InvalidInputError
from roboneuron.modules.plugin import load_profile
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import RobotSpec
from roboneuron.server.motion_gate import ExposedEndpoint
from roboneuron.tools.ros.exposed_types import is_joint_limited, is_velocity_type, renamed
from roboneuron.tools.ros.interfaces import (
    LOSSLESS,
    MessageInterface,
    load_interface,
    load_message,
)
from roboneuron.tools.ros.options import DiscoverConfig, ExposeConfig, RosToolsOptions
from roboneuron.tools.ros.parameter_nodes import ParameterNode, parameter_node, same_for_each_node
from roboneuron.tools.ros.pattern_limits import pattern_limits
from roboneuron.tools.ros.tightening import ConfiguredLimits, tighten


@dataclass(frozen=True, kw_only=True, slots=True)
class Exposure:
    """All exposed endpoints of the configuration.

    Attributes:
        endpoints: topics, services and actions.
        nodes: nodes with parameters.
        omitted: endpoints that are left out because their type cannot be used; a sentence each.
    """

    endpoints: tuple[ExposedEndpoint, ...] = ()
    nodes: tuple[ParameterNode, ...] = ()
    omitted: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _ExposedRobot:
    name: str
    namespace: str
    profile: RobotProfile | None
    endpoints: tuple[ExposedEndpoint, ...]
    """Those of the profile whose type can be used."""


def exposure(
    config: Config, options: RosToolsOptions, registry: Registry, added: Iterable[ExposeConfig] = ()
) -> Exposure:
    """Collect the endpoints exposed by the robot's profile and the configuration.

    Args:
        config: the configuration with the present robot.
        options: the exposed entries.
        registry: provides the profiles.
        added: entries added at run time, which can only tighten the limits of a topic.

    An endpoint whose type cannot be used is left out and named, but for added ones.

    Raises:
        ConfigurationError: an entry names something unknown, is incomplete, widens a limit, or
            occurs twice.
        PluginError, MissingDependencyError: a profile cannot be loaded.
    """
    robots: dict[str, _ExposedRobot] = {}
    known: dict[Use, list[ExposedEndpoint]] = {}
    """All entries by topic, also those of profiles and those whose name was given to another topic
    since.
    """

    def find(name: str, namespace: str | None) -> _ExposedRobot:
        if name not in robots:
            is_own = name == config.robot.name
            own = config.namespace if is_own else name.replace("-", "_")
            profile = None
            if name in registry.specs(RobotSpec):
                profile = load_profile(registry, config.robot if is_own else name)
            space = namespace or own
            if any(robot.namespace == space for robot in robots.values()):
                raise ConfigurationError(
                    f"Robot {name!r} cannot have the namespace {space!r}: another robot has it."
                )
            listed = profile_endpoints(name, space, profile)
            usable = tuple(filter(is_usable, listed))
            robots[name] = _ExposedRobot(
                name=name, namespace=space, profile=profile, endpoints=usable
            )
            for exposed in robots[name].endpoints:
                known.setdefault((exposed.topic, exposed.endpoint.kind), []).append(exposed)
        found = robots[name]
        if namespace is not None and namespace != found.namespace:
            raise ConfigurationError(
                f"Robot {name!r} is given two namespaces, {found.namespace!r} and {namespace!r}."
            )
        return found

    omitted: list[str] = []

    def is_usable(exposed: ExposedEndpoint) -> bool:
        try:
            load_interface(exposed.endpoint.type)
        except UnusableTypeError as error:
            omitted.append(f"Endpoint {exposed.label!r} of {exposed.robot!r}: {error}")
            return False
        return True

    drafts: dict[tuple[str, str, str], ExposedEndpoint] = {}
    nodes: list[ParameterNode] = []

    def take(entry: ExposeConfig, patterns: Iterable[DiscoverConfig]) -> None:
        robot = find(entry.robot or config.robot.name, entry.namespace)
        if entry.kind == "parameters":
            nodes.append(parameter_node(entry, robot.name, robot.namespace))
        elif entry.name is None:
            drafts.update((_key(e), e) for e in _whole_profile(entry, robot))
        else:
            made = _merge(entry, robot, drafts, known, patterns)
            drafts[_key(made)] = made
            known.setdefault((made.topic, made.endpoint.kind), []).append(made)

    main = find(config.robot.name, config.namespace)
    if options.direct.profile:
        drafts.update((_key(e), e) for e in main.endpoints)
    for entry in options.expose:
        try:
            take(entry, ())
        except UnusableTypeError as error:
            omitted.append(f"[[expose]] {entry.name!r}: {error}")
    configured = by_topic(drafts.values())
    for entry in added:
        take(entry, options.discover)
    namespaces = {robot.namespace: robot.name for robot in robots.values()}
    shown = same_for_each_topic(drafts.values(), known)
    for exposed in shown:
        check_reserved(exposed, namespaces)
    made = tuple(unique(_not_looser(shown, configured)))
    kept = tuple(same_for_each_node(nodes, namespaces))
    return Exposure(endpoints=made, nodes=kept, omitted=tuple(omitted))


def unique(drafts: Iterable[ExposedEndpoint]) -> Iterator[ExposedEndpoint]:
    """Give the endpoints of a robot unique names if a label is used for two kinds; check each."""
    listed = list(drafts)
    labels: dict[tuple[str, str], int] = {}
    for draft in listed:
        labels[draft.robot, draft.label] = labels.get((draft.robot, draft.label), 0) + 1
    for draft in listed:
        shared = labels[draft.robot, draft.label] > 1
        name = f"{draft.label[:50]}_{draft.endpoint.kind}" if shared else draft.label
        made = renamed(draft, name) if name != draft.endpoint.name else draft
        check_endpoint(made.endpoint)
        check_stop(made)
        yield made


def _key(exposed: ExposedEndpoint) -> tuple[str, str, str]:
    return exposed.robot, exposed.label, exposed.endpoint.kind


def _whole_profile(entry: ExposeConfig, robot: _ExposedRobot) -> list[ExposedEndpoint]:
    if robot.profile is None:
        raise ConfigurationError(
            f"[[expose]] for robot {robot.name!r} names no endpoint, and no installed plugin "
            "offers such a robot."
        )
    return [replace(e, moves=entry.moves, require_subscriber=entry.require_subscriber)
            for e in robot.endpoints]  # fmt: skip


def _merge(
    entry: ExposeConfig,
    robot: _ExposedRobot,
    drafts: dict[tuple[str, str, str], ExposedEndpoint],
    known: Mapping[Use, Iterable[ExposedEndpoint]],
    patterns: Iterable[DiscoverConfig],
) -> ExposedEndpoint:
    """Create the endpoint of an entry: limits on an endpoint of the profile, or a new endpoint,
    within the known limits of the topic.
    """
    assert entry.name is not None
    mine = [e for key, e in drafts.items() if key[:2] == (robot.name, entry.name)]
    own = [*mine, *(e for e in robot.endpoints if e.label == entry.name)]
    base = next(
        (
            e
            for e in own
            if entry.kind in (None, e.endpoint.kind) and entry.type in (None, e.endpoint.type)
        ),
        None,
    )
    limits = ConfiguredLimits(
        bounds={path: (low, high) for path, (low, high) in entry.bounds.items()},
        rate_hz=entry.rate_hz,
        frame=entry.frame,
        zones=tuple(
            Obstacle(name=z.name, lower_m=np.array(z.lower_m), upper_m=np.array(z.upper_m))
            for z in entry.zones
        ),
        clamp=frozenset(entry.clamp),
    )
    if base is None:
        missing = [key for key in ("kind", "topic", "type") if getattr(entry, key) is None]
        if missing:
            raise ConfigurationError(
                f"[[expose]] {entry.name!r} of robot {robot.name!r} lacks {', '.join(missing)}.",
                hint="Only an endpoint of the robot's profile can be named alone.",
            )
        assert entry.type is not None
        full = load_interface(entry.type).name
        if entry.type != full:
            raise ConfigurationError(f"Endpoint {entry.name!r}: write the type in full, {full}.")
        is_bare_velocity = "stop_message" not in entry.model_fields_set and is_velocity_type(
            str(entry.kind), entry.type
        )
        stop = "zero" if is_bare_velocity else _stop_text(entry, entry.type)
        bare = Endpoint(
            name=entry.name, kind=str(entry.kind), topic=str(entry.topic), type=entry.type,
            summary=entry.summary, stop_message=stop, repeat_hz=entry.repeat_hz or 0.0,
            joint_limited=is_joint_limited(str(entry.kind), entry.type, robot.profile)
            and (entry.moves or entry.type in JOINT_TYPES),
        )  # fmt: skip
    else:
        bare = replace(
            base.endpoint,
            topic=entry.topic or base.endpoint.topic,
            summary=entry.summary or base.endpoint.summary,
            stop_message=_stop_text(entry, base.endpoint.type) or base.endpoint.stop_message,
            repeat_hz=base.endpoint.repeat_hz if entry.repeat_hz is None else entry.repeat_hz,
        )
    check_endpoint(bare)
    topic = bare.topic if bare.topic.startswith("/") else f"/{robot.namespace}/{bare.topic}"
    for source in known.get((topic, bare.kind), ()):
        bare = tightened_by(bare, source.endpoint)
    bare = pattern_limits(bare, topic, patterns)
    nonfinite = frozenset(entry.nonfinite)
    interface = load_interface(bare.type, nonfinite=nonfinite)  # raises for a non-float path
    if (bare.kind in ("publish", "read")) is not isinstance(interface, MessageInterface):
        raise ConfigurationError(
            f"Endpoint {entry.name!r}: a {bare.kind} cannot be of {bare.type}."
        )
    return ExposedEndpoint(
        robot=robot.name,
        namespace=robot.namespace,
        label=entry.name,
        endpoint=tighten(bare, limits),
        profile=robot.profile,
        clamp=limits.clamp,
        nonfinite=nonfinite,
        require_subscriber=entry.require_subscriber,
        moves=entry.moves,
    )


def _stop_text(entry: ExposeConfig, type_name: str) -> str:
    """Format the stop message for an `Endpoint`: the different notations of agents are
    normalised.
    """
    given = entry.stop_message
    if isinstance(given, str):
        return given
    part = load_message(type_name, nonfinite=frozenset(entry.nonfinite))
    try:
        return json.dumps(part.decode(part.encode(given, now_ns=None), LOSSLESS))
    except InvalidInputError as error:
        raise ConfigurationError(f"The stop message of {entry.name!r}: {error}") from error


def _not_looser(
    drafts: Iterable[ExposedEndpoint], before: Mapping[Use, Sequence[ExposedEndpoint]]
) -> Iterator[ExposedEndpoint]:
    """Check that entries added at run time neither exempt a configured topic from the policy's
    exclusive use, nor widen its accepted values.
    """
    for draft in drafts:
        same = before.get((draft.topic, draft.endpoint.kind), ())
        yield same_for_each_topic([draft, *same], {})[0] if same else draft
