"""What is exposed: the endpoints of robot profiles and of the configuration, checked, with limits tightened."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from roboneuron.config import Config, DiscoverConfig, ExposeConfig
from roboneuron.contract import Endpoint, RobotProfile
from roboneuron.errors import ConfigurationError, InvalidInputError
from roboneuron.gate import AllowedEndpoint, ConfiguredLimits, check_endpoint, tighten
from roboneuron.gate.joints import JOINT_TYPES
from roboneuron.gate.limits import sent_types
from roboneuron.interfaces import Interface, MessageInterface, load_interface
from roboneuron.modules.plugin import load_profile
from roboneuron.plugins.registry import Registry
from roboneuron.server.direct.parameter_nodes import ParameterNode, parameter_node, same_for_each_node
from roboneuron.server.direct.topic_limits import (
    Use,
    by_topic,
    check_reserved,
    not_looser,
    pattern_limits,
    same_for_each_topic,
    tightened_by,
)

_VELOCITIES = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Exposed:
    """An endpoint of one robot that agents may use.

    Attributes:
        robot: its name.
        namespace: its ROS namespace, without a leading slash.
        label: noun in the names of its tools.
        endpoint: the gate's entry; its name is unique among the robot's.
        interface: the type.
        profile: the robot's facts, None for a robot that no plugin knows.
        clamp, nonfinite: see `AllowedEndpoint`.
        require_subscriber: a message that nobody receives is an error.
        moves: it moves the robot, so that it is refused while a policy does.
        hidden: no tools of its own; another tool uses it.
    """

    robot: str
    namespace: str
    label: str
    endpoint: Endpoint
    interface: Interface
    profile: RobotProfile | None = None
    clamp: frozenset[str] = frozenset()
    nonfinite: frozenset[str] = frozenset()
    require_subscriber: bool = True
    moves: bool = True
    hidden: bool = False

    @property
    def topic(self) -> str:
        """Absolute name of the topic, service or action."""
        name = self.endpoint.topic
        return name if name.startswith("/") else f"/{self.namespace}/{name}"

    @property
    def message(self) -> MessageInterface:
        """The type as a message; only for topics."""
        assert isinstance(self.interface, MessageInterface)
        return self.interface

    def allowed(self) -> AllowedEndpoint:
        """The entry of the gate's allow list."""
        return AllowedEndpoint(
            robot=self.robot,
            endpoint=self.endpoint,
            profile=self.profile,
            clamp=self.clamp,
            nonfinite=self.nonfinite,
            topic=self.topic,
        )

    def stop_message(self, now_ns: int) -> Any:
        """The message that ends a motion, or None."""
        text = self.endpoint.stop_message
        if not text:
            return None
        if text != "zero":
            return self.message.encode(json.loads(text), now_ns=now_ns)
        message = self.message.ros_type()
        header = getattr(message, "header", None)
        if header is not None and hasattr(header, "stamp"):
            header.stamp.sec, header.stamp.nanosec = divmod(now_ns, 1_000_000_000)
        return message


@dataclass(frozen=True, kw_only=True, slots=True)
class Exposure:
    """Everything that the configuration exposes."""

    endpoints: tuple[Exposed, ...] = ()
    nodes: tuple[ParameterNode, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Robot:
    name: str
    namespace: str
    profile: RobotProfile | None


def exposure(config: Config, registry: Registry, added: Iterable[ExposeConfig] = ()) -> Exposure:
    """Collect what the robot's profile and the configuration expose.

    Args:
        config: its `expose`.
        registry: where profiles are found.
        added: entries of run time, which can only tighten what the others say about a topic.

    Raises:
        ConfigurationError: an entry names what does not exist, is incomplete, widens a limit, or comes twice.
        PluginError, MissingDependencyError: a profile cannot be loaded.
    """
    robots: dict[str, _Robot] = {}
    known: dict[Use, list[Exposed]] = {}
    """All that was said about topics, also by profiles and under a name that was given to another topic since."""

    def find(name: str, namespace: str | None) -> _Robot:
        if name not in robots:
            own = config.namespace if name == config.robot.name else name.replace("-", "_")
            profile = load_profile(registry, name) if name in registry.specs("robot") else None
            space = namespace or own
            if any(robot.namespace == space for robot in robots.values()):
                raise ConfigurationError(f"Robot {name!r} cannot have the namespace {space!r}: another robot has it.")
            robots[name] = _Robot(name=name, namespace=space, profile=profile)
            for exposed in _profile_endpoints(robots[name]):
                known.setdefault((exposed.topic, exposed.endpoint.kind), []).append(exposed)
        found = robots[name]
        if namespace is not None and namespace != found.namespace:
            raise ConfigurationError(f"Robot {name!r} is given two namespaces, {found.namespace!r} and {namespace!r}.")
        return found

    drafts: dict[tuple[str, str, str], Exposed] = {}
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
    if config.direct.profile:
        drafts.update((_key(e), e) for e in _profile_endpoints(main))
    for entry in config.expose:
        take(entry, ())
    configured = by_topic(drafts.values())
    for entry in added:
        take(entry, config.discover)
    namespaces = {robot.namespace: robot.name for robot in robots.values()}
    shown = same_for_each_topic(drafts.values(), known)
    for exposed in shown:
        check_reserved(exposed, namespaces)
    made = tuple(unique(not_looser(shown, configured)))
    return Exposure(endpoints=made, nodes=tuple(same_for_each_node(nodes, namespaces)))


def unique(drafts: Iterable[Exposed]) -> Iterator[Exposed]:
    """Give the endpoints of a robot names of their own where a label is used for two kinds; check each."""
    listed = list(drafts)
    labels: dict[tuple[str, str], int] = {}
    for draft in listed:
        labels[draft.robot, draft.label] = labels.get((draft.robot, draft.label), 0) + 1
    for draft in listed:
        shared = labels[draft.robot, draft.label] > 1
        name = f"{draft.label[:50]}_{draft.endpoint.kind}" if shared else draft.label
        made = replace(draft, endpoint=replace(draft.endpoint, name=name)) if name != draft.endpoint.name else draft
        check_endpoint(made.endpoint)
        check_stop(made)
        yield made


def is_velocity(kind: str, type_name: str) -> bool:
    """Whether a robot goes on at what it was told until it is told something else, so that it has to end in zero."""
    return kind == "publish" and type_name in _VELOCITIES


def is_joint_limited(kind: str, type_name: str, profile: RobotProfile | None) -> bool:
    """Whether a new endpoint takes joint commands, alone or in a goal or request, of a robot with joint limits."""
    if kind == "read" or profile is None or profile.limits is None:
        return False
    return type_name in JOINT_TYPES or any(name in JOINT_TYPES for name in sent_types(kind, type_name))


def _key(exposed: Exposed) -> tuple[str, str, str]:
    return exposed.robot, exposed.label, exposed.endpoint.kind


def _profile_endpoints(robot: _Robot) -> list[Exposed]:
    endpoints = robot.profile.endpoints if robot.profile is not None else ()
    return [
        Exposed(
            robot=robot.name,
            namespace=robot.namespace,
            label=endpoint.name,
            endpoint=endpoint,
            interface=load_interface(endpoint.type),
            profile=robot.profile,
        )
        for endpoint in endpoints
    ]


def _whole_profile(entry: ExposeConfig, robot: _Robot) -> list[Exposed]:
    if robot.profile is None:
        raise ConfigurationError(
            f"[[expose]] for robot {robot.name!r} names no endpoint, and no installed plugin offers such a robot."
        )
    return [replace(e, moves=entry.moves, require_subscriber=entry.require_subscriber)
            for e in _profile_endpoints(robot)]  # fmt: skip


def _merge(
    entry: ExposeConfig,
    robot: _Robot,
    drafts: dict[tuple[str, str, str], Exposed],
    known: Mapping[Use, Iterable[Exposed]],
    patterns: Iterable[DiscoverConfig],
) -> Exposed:
    """The endpoint of an entry: limits on one of the profile, or a new one, within what is known about the topic."""
    assert entry.name is not None
    mine = [e for key, e in drafts.items() if key[:2] == (robot.name, entry.name)]
    own = [*mine, *(e for e in _profile_endpoints(robot) if e.label == entry.name)]
    base = next(
        (e for e in own if entry.kind in (None, e.endpoint.kind) and entry.type in (None, e.endpoint.type)), None
    )
    limits = ConfiguredLimits(
        bounds={path: (low, high) for path, (low, high) in entry.bounds.items()},
        rate_hz=entry.rate_hz,
        clamp=frozenset(entry.clamp),
    )
    stop = entry.stop_message if isinstance(entry.stop_message, str) else json.dumps(entry.stop_message)
    if base is None and "stop_message" not in entry.model_fields_set and is_velocity(str(entry.kind), entry.type or ""):
        stop = "zero"
    if base is None:
        missing = [key for key in ("kind", "topic", "type") if getattr(entry, key) is None]
        if missing:
            raise ConfigurationError(
                f"[[expose]] {entry.name!r} of robot {robot.name!r} lacks {', '.join(missing)}.",
                hint="Only an endpoint of the robot's profile can be named alone.",
            )
        bare = Endpoint(
            name=entry.name, kind=str(entry.kind), topic=str(entry.topic), type=str(entry.type),
            summary=entry.summary, stop_message=stop, repeat_hz=entry.repeat_hz or 0.0,
            joint_limited=is_joint_limited(str(entry.kind), str(entry.type), robot.profile)
            and (entry.moves or entry.type in JOINT_TYPES),
        )  # fmt: skip
    else:
        bare = replace(
            base.endpoint,
            topic=entry.topic or base.endpoint.topic,
            summary=entry.summary or base.endpoint.summary,
            stop_message=stop or base.endpoint.stop_message,
            repeat_hz=base.endpoint.repeat_hz if entry.repeat_hz is None else entry.repeat_hz,
        )
    check_endpoint(bare)
    topic = bare.topic if bare.topic.startswith("/") else f"/{robot.namespace}/{bare.topic}"
    for source in known.get((topic, bare.kind), ()):
        bare = tightened_by(bare, source.endpoint)
    bare = pattern_limits(bare, topic, patterns)
    nonfinite = frozenset(entry.nonfinite)
    return Exposed(
        robot=robot.name,
        namespace=robot.namespace,
        label=entry.name,
        endpoint=tighten(bare, limits),
        interface=load_interface(bare.type, nonfinite=nonfinite),
        profile=robot.profile,
        clamp=limits.clamp,
        nonfinite=nonfinite,
        require_subscriber=entry.require_subscriber,
        moves=entry.moves,
    )


def check_stop(exposed: Exposed) -> None:
    """Raise ConfigurationError unless the stop message is one that the endpoint takes."""
    if not exposed.endpoint.stop_message:
        return
    where = f"The stop message of {exposed.endpoint.name!r}"
    if exposed.endpoint.kind != "publish":
        raise ConfigurationError(f"{where} makes no sense: it is a {exposed.endpoint.kind}.")
    try:
        exposed.stop_message(0)
    except InvalidInputError as error:
        raise ConfigurationError(f"{where}: {error}") from error
    outside = [path for path, (low, high) in exposed.endpoint.bounds.items() if not low <= 0.0 <= high]
    if exposed.endpoint.stop_message == "zero" and outside:
        raise ConfigurationError(f"{where} is zero, which the bounds of {outside[0]} do not allow.")
