"""What is base, TCP, arm and gripper in a robot description: guessed, with the grounds.

A description names no such parts. Guesses follow names that public descriptions have in common
(ROS REP 199, MoveIt's and the manufacturers' packages) and the shape of the tree of joints.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rn_standard.declared_arm.urdf_joints import MOVABLE
from rn_standard.declared_arm.urdf_tree import UrdfTree
from roboneuron import ConfigurationError

NO_GRIPPER = "none"
"""Value of `--gripper` for an arm without one."""
_FINGERS = re.compile(r"(?i)finger|gripper|jaw|claw|knuckle|thumb|(?<![a-z])grip(?![a-z])")
_SENSORS = re.compile(
    r"(?i)camera|optical|sensor|imu|accel|laser|range|depth|color|infra|(?<![a-z])ft(?![a-z])"
)
_TOOLS = (
    (re.compile(r"(?i)tcp"), "'tcp' in its name"),
    (re.compile(r"(?i)tool_?0$"), "the tool frame of REP 199, tool0"),
    (re.compile(r"(?i)grasp|pinch|gripper_frame|gripper_center"), "named as the place of grasping"),
    (re.compile(r"(?i)tool"), "'tool' in its name"),
    (re.compile(r"(?i)(?<![a-z])(ee|eef)(?![a-z])|end_?effector"), "named as the end effector"),
    (re.compile(r"(?i)(?<![a-z])hand(?![a-z])|flange|gripper"), "named as hand or flange"),
)
_BASES = re.compile(r"(?i)(?<![a-z])base(?![a-z])")
_WORLDS = re.compile(r"(?i)^(world|map|ground|table|stand)(_link)?$")
_RIVAL_SHARE = 0.5
"""A branch with this share of the longest one's joints could be the arm as well."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Chosen:
    """What a person has said; None or () leaves a part to the guess."""

    base: str | None = None
    tcp: str | None = None
    joints: tuple[str, ...] = ()
    gripper: str | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class GuessedGripper:
    """The joint that drives the gripper.

    Attributes:
        joint: its name.
        closed, opened: positions [rad or m].
        is_measured: the description says which end is open, by where its fingers are.
        followers: joints that follow it.
    """

    joint: str
    closed: float
    opened: float
    is_measured: bool
    followers: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class ArmParts:
    """The parts of one arm.

    Attributes:
        base, tcp: links.
        joints: base to tip.
        gripper: None without one.
        grounds: by part ("base", "tcp", "joints", "gripper"): why it was chosen.
        left: joints that move by themselves and are no part of the arm.
    """

    base: str
    tcp: str
    joints: tuple[str, ...]
    gripper: GuessedGripper | None
    grounds: dict[str, str]
    left: tuple[str, ...]


def guess(tree: UrdfTree, chosen: Chosen) -> ArmParts:
    """The parts of the arm.

    Raises:
        ConfigurationError: a chosen part does not exist or does not fit the others, or there are
            several candidates, which it names.
    """
    _check(tree, chosen)
    grounds = dict.fromkeys(("base", "tcp", "joints"), "as you said")
    tcp = chosen.tcp
    if tcp is None:
        last = _last_joint(tree, chosen)
        tcp, grounds["tcp"] = _guess_tcp(tree, last)
    joints = tree.arm_joints(tcp)
    if not joints:
        raise ConfigurationError(f"No joint moves {tcp!r}.", hint="Choose another link with --tcp.")
    if chosen.joints:
        joints = _from_first(tree, joints, chosen.joints, tcp)
    if chosen.base is None:
        base, grounds["base"] = _guess_base(tree, joints[0])
    else:
        base = chosen.base
        joints = _above(tree, joints, base, tcp)
    if not chosen.joints:
        grounds["joints"] = "all that move between base and TCP and follow no other one"
    hanging = _hanging(tree, joints)
    gripper, grounds["gripper"] = _guess_gripper(tree, hanging, tcp, chosen.gripper)
    used = {*joints, *((gripper.joint,) if gripper else ())}
    left = tuple(name for name in tree.leaders() if name not in used)
    return ArmParts(
        base=base,
        tcp=tcp,
        joints=tuple(joints),
        gripper=gripper,
        grounds=grounds,
        left=left,
    )


def _check(tree: UrdfTree, chosen: Chosen) -> None:
    for option, link in (("--base", chosen.base), ("--tcp", chosen.tcp)):
        if link is not None:
            tree.check_link(link, option)
    for joint in chosen.joints:
        tree.check_joint(joint, "--joints")
    if chosen.gripper not in (None, NO_GRIPPER):
        assert chosen.gripper is not None
        tree.check_joint(chosen.gripper, "--gripper")


def _last_joint(tree: UrdfTree, chosen: Chosen) -> str:
    """The joint that carries the tool. Raises ConfigurationError if several could."""
    if chosen.joints:
        return max(chosen.joints, key=lambda name: len(tree.chain(tree.joint(name).child)))
    arm = [name for name in tree.leaders() if not _is_finger(tree, name)]
    if chosen.base is not None:
        arm = [name for name in arm if _hangs_from(tree, name, chosen.base)]
    if not arm:
        where = "" if chosen.base is None else f" below {chosen.base!r}"
        raise ConfigurationError(
            f"No joint{where} looks like one of an arm; those that move are "
            f"{', '.join(tree.leaders())}.",
            hint="Name them, base to tip, with --joints.",
        )
    ends = [name for name in arm if not any(other.name in arm for other in tree.descendants(name))]
    counts = {name: len(tree.arm_joints(tree.joint(name).child)) for name in ends}
    most = max(counts.values())
    rivals = [name for name, count in counts.items() if count >= _RIVAL_SHARE * most]
    if len(rivals) > 1:
        tips = [_guess_tcp(tree, name, ask=False)[0] for name in rivals]
        told = ", ".join(
            f"{tip} (moved by {counts[name]} joints)"
            for tip, name in zip(tips, rivals, strict=True)
        )
        raise ConfigurationError(
            f"The robot description has {len(rivals)} branches that could be the arm: {told}.",
            hint=f"Choose one, such as --tcp {tips[0]}; the other joints stay at rest.",
        )
    return rivals[0]


def _is_finger(tree: UrdfTree, name: str) -> bool:
    """Named as one, or the only link that it carries; or it leads joints and carries no others."""
    if _FINGERS.search(name):
        return True
    led = {follower for follower, leader in tree.followers.items() if leader == name}
    moving = {other.name for other in tree.descendants(name) if other.kind in MOVABLE}
    return moving <= led and bool(led or _FINGERS.search(tree.joint(name).child))


def _hangs_from(tree: UrdfTree, joint: str, link: str) -> bool:
    return link == tree.root or any(above.child == link for above in tree.chain(tree.parent(joint)))


def _guess_tcp(tree: UrdfTree, last: str, *, ask: bool = True) -> tuple[str, str]:
    """The link of the tool on a joint, and the grounds. Raises ConfigurationError for several if
    `ask`.
    """
    links = list(tree.rigid(tree.joint(last).child))
    tools = [link for link in links if not _SENSORS.search(link)] or links
    for pattern, ground in _TOOLS:
        named = [link for link in tools if pattern.search(link)]
        ends = [link for link in named if not set(tree.rigid(link)) & {*named} - {link}]
        if len(ends) > 1 and ask:
            raise _several_tools(last, ends)
        if ends:
            return ends[0], f"on the last joint, {ground}"
    ends = [link for link in tools if not set(tree.rigid(link)) & {*tools} - {link}]
    if len(ends) > 1 and ask:
        raise _several_tools(last, ends)
    return ends[0], "the only link at the end of the arm"


def _several_tools(last: str, ends: Sequence[str]) -> ConfigurationError:
    return ConfigurationError(
        f"Several links on the last joint {last!r} could be the TCP: {', '.join(ends)}.",
        hint=f"Choose the one whose z axis points out of the tool, such as --tcp {ends[0]}.",
    )


def _from_first(tree: UrdfTree, chain: list[str], wanted: Sequence[str], tcp: str) -> list[str]:
    """The joints of the chain from the first wanted one on, which must be the wanted ones."""
    apart = [name for name in wanted if name not in chain]
    if apart:
        raise ConfigurationError(
            f"--joints: {', '.join(apart)} does not move the TCP {tcp!r}; its joints are "
            f"{', '.join(chain)}."
        )
    joints = chain[min(chain.index(name) for name in wanted) :]
    missing = [name for name in joints if name not in wanted]
    if missing:
        raise ConfigurationError(
            f"--joints lacks {', '.join(missing)}, which moves the TCP {tcp!r} as well.",
            hint="Name it too, or make it fixed in the description.",
        )
    return joints


def _guess_base(tree: UrdfTree, first: str) -> tuple[str, str]:
    """The link in whose frame poses are, and the grounds: it is fixed to what carries the first
    joint.
    """
    above = tree.chain(tree.parent(first))
    start = max((i + 1 for i, joint in enumerate(above) if joint.kind != "fixed"), default=0)
    links = [joint.child for joint in above][max(start - 1, 0) :]
    links = links if start else [tree.root, *links]
    for link in links:
        if _BASES.search(link):
            return link, "below the first joint, 'base' in its name"
    if start:
        return links[-1], "carries the first joint"
    own = [link for link in links if not _WORLDS.search(link)]
    return (own or links)[0], "the first link of the description that is no world"


def _above(tree: UrdfTree, joints: list[str], base: str, tcp: str) -> list[str]:
    """The joints between a base and the TCP. Raises ConfigurationError if it does not hang there,
    or a joint in between is of a kind that no controller moves.
    """
    chain = tree.chain(tcp)
    places = [tree.root, *(joint.child for joint in chain)]
    if base not in places:
        raise ConfigurationError(
            f"The TCP {tcp!r} does not hang from the base {base!r}.",
            hint=f"Links above it are {', '.join(places[:-1])}.",
        )
    between = {joint.name for joint in chain[places.index(base) :]}
    kept = [name for name in joints if name in between]
    if not kept:
        raise ConfigurationError(f"No joint moves the TCP {tcp!r} against the base {base!r}.")
    return kept


def _hanging(tree: UrdfTree, joints: Sequence[str]) -> list[str]:
    """The joints that move by themselves on the last link of the arm."""
    return [
        other.name
        for other in tree.descendants(joints[-1])
        if other.name in tree.leaders() and other.name not in joints
    ]


def _guess_gripper(
    tree: UrdfTree, hanging: list[str], tcp: str, chosen: str | None
) -> tuple[GuessedGripper | None, str]:
    if chosen == NO_GRIPPER:
        return None, "as you said"
    if chosen is not None:
        return _gripper(tree, chosen, tcp), "as you said"
    if not hanging:
        return None, "no joint moves on the last link"
    leading = [name for name in hanging if name in tree.followers.values()]
    one = leading if len(leading) == 1 else hanging
    if len(one) > 1:
        return None, (
            f"{', '.join(hanging)} move by themselves, and one joint drives a gripper: let the "
            "others follow it by <mimic>, or choose one with --gripper"
        )
    ground = "the joint on the last link that others follow" if leading else "the only joint there"
    return _gripper(tree, one[0], tcp), ground


def _gripper(tree: UrdfTree, joint: str, tcp: str) -> GuessedGripper:
    """Raises ConfigurationError for a joint without two limits."""
    lower, upper = tree.kinds.limits(joint)
    if not (np.isfinite([lower, upper]).all() and lower < upper):
        raise ConfigurationError(
            f"The gripper's joint {joint!r} has the limits {lower:g} .. {upper:g}, expected two.",
            hint="Correct them in the description, or go without by --gripper none.",
        )
    followers = tuple(name for name, leader in tree.followers.items() if leader == joint)
    apart = [_spread(tree, joint, followers, position) for position in (lower, upper)]
    is_measured = abs(apart[1] - apart[0]) > 1e-3
    is_lower_open = is_measured and apart[0] > apart[1]
    closed, opened = (upper, lower) if is_lower_open else (lower, upper)
    return GuessedGripper(
        joint=joint,
        closed=closed,
        opened=opened,
        is_measured=is_measured,
        followers=followers,
    )


def _spread(tree: UrdfTree, joint: str, followers: Sequence[str], position: float) -> float:
    """Largest distance [m] between links that the gripper's joints move, by their origins; 0 for
    one link.
    """
    configuration = tree.kinds.configuration()
    placed = dict(
        zip(configuration.order, configuration.of({joint: position}).tolist(), strict=True)
    )
    moved = {tree.joint(name).child for name in (joint, *followers)}
    places = []
    for link in moved:
        pose = np.eye(4)
        for part in tree.chain(link):
            pose = pose @ part.transform(placed.get(part.name, 0.0))
        places.append(pose[:3, 3])
    return max(
        (float(np.linalg.norm(one - other)) for one in places for other in places), default=0.0
    )
