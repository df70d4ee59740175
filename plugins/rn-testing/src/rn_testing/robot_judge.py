"""Where the links of a robot are and how far apart, from its URDF alone, in plain numpy.

A judge for controllers, views and recordings: it shares no code with them, nor with the contract of
the core. Shapes are spheres, whose distances are exact.
"""

from __future__ import annotations

import math
import random
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from roboneuron import F64


class JudgedRobot:
    """Positions by name -> poses of links; joints that are not named are at 0."""

    def __init__(self, urdf: str) -> None:
        """Args:
        urdf: the description.
        """
        root = ElementTree.fromstring(urdf)
        self._joints = {_get(j, "child", "link", ""): j for j in root.findall("joint")}
        self._by_name = {j.get("name", ""): j for j in self._joints.values()}
        self._links = [link.get("name", "") for link in root.findall("link")]
        self.spheres = {
            link.get("name", ""): [
                (_numbers(_get(shape, "origin", "xyz", "0 0 0")), float(ball.get("radius", "0")))
                for shape in link.findall("collision")
                for ball in shape.iter("sphere")
            ]
            for link in root.findall("link")
        }

    def position(self, joint: str, positions: Mapping[str, float]) -> float:
        """Position of a joint; one that mimics another has no say in it."""
        mimic = self._by_name[joint].find("mimic")
        if mimic is None:
            return positions.get(joint, 0.0)
        leads = self.position(mimic.get("joint", ""), positions)
        return float(mimic.get("multiplier", "1")) * leads + float(mimic.get("offset", "0"))

    def pose(self, link: str, positions: Mapping[str, float], base: str) -> F64:
        """Pose of a link in another one, float64 (4, 4)."""
        return np.asarray(np.linalg.inv(self._from_root(base, positions))) @ self._from_root(
            link, positions
        )

    def distance(self, one: str, other: str, positions: Mapping[str, float]) -> float:
        """Distance of the spheres of two links [m]; negative where they overlap."""
        return min(
            math.dist(a, b) - r - s
            for a, r in self._centres(one, positions)
            for b, s in self._centres(other, positions)
        )

    def box_distance(
        self, link: str, positions: Mapping[str, float], base: str, lower: F64, upper: F64
    ) -> float:
        """Distance of a link's spheres from a box in the frame of `base` [m]; a centre in the box
        counts by its depth.
        """
        into = np.linalg.inv(self._from_root(base, positions))
        return min(
            _box_distance(into[:3, :3] @ centre + into[:3, 3], lower, upper) - radius
            for centre, radius in self._centres(link, positions)
        )

    def _centres(self, link: str, positions: Mapping[str, float]) -> list[tuple[F64, float]]:
        pose = self._from_root(link, positions)
        return [(pose[:3, :3] @ at + pose[:3, 3], radius) for at, radius in self.spheres[link]]

    def _from_root(self, link: str, positions: Mapping[str, float]) -> F64:
        pose = np.eye(4)
        while link in self._joints:
            joint = self._joints[link]
            pose = self._moved(joint, positions) @ pose
            link = _get(joint, "parent", "link", "")
        return pose

    def _moved(self, joint: ElementTree.Element, positions: Mapping[str, float]) -> F64:
        roll, pitch, yaw = _numbers(_get(joint, "origin", "rpy", "0 0 0"))
        x, y, z = np.eye(3)
        pose, motion = np.eye(4), np.eye(4)
        pose[:3, :3] = rotation(z, yaw) @ rotation(y, pitch) @ rotation(x, roll)
        pose[:3, 3] = _numbers(_get(joint, "origin", "xyz", "0 0 0"))
        kind, name = joint.get("type"), joint.get("name", "")
        axis = _numbers(_get(joint, "axis", "xyz", "1 0 0"))
        axis /= np.linalg.norm(axis) or 1.0
        if kind == "prismatic":
            motion[:3, 3] = axis * self.position(name, positions)
        elif kind in ("revolute", "continuous"):
            motion[:3, :3] = rotation(axis, self.position(name, positions))
        return pose @ motion


def rotation(axis: F64, angle: float) -> F64:
    """Rotation matrix about a unit axis, by quaternion."""
    w, (x, y, z) = math.cos(angle / 2.0), axis * math.sin(angle / 2.0)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class RandomChain:
    """A robot of n links on a base, each with a sphere, and a TCP.

    Attributes:
        urdf: the description, its links and joints in random order.
        kinds: by joint, base to tip: "revolute", "continuous", "prismatic" or "mimic".
        lower, upper: position limits by joint that is no follower; wide for those that turn.
    """

    urdf: str
    kinds: Mapping[str, str]
    lower: Mapping[str, float]
    upper: Mapping[str, float]

    @property
    def arm(self) -> tuple[str, ...]:
        """The joints that are no followers, base to tip."""
        return tuple(name for name, kind in self.kinds.items() if kind != "mimic")


def random_chain(kinds: Sequence[str], seed: int, shape: str = "") -> RandomChain:
    """A chain of joints of these kinds; followers follow any other one, also another follower.

    Args:
        kinds: of the joints, base to tip.
        seed: of the geometry and the order of the elements.
        shape: XML of a `<geometry>` for each link instead of a sphere.
    """
    rng = random.Random(seed)
    names = [f"j{rng.randrange(100):02d}_{i}" for i in range(len(kinds))]
    leaders = [name for name, kind in zip(names, kinds, strict=True) if kind != "mimic"]
    elements, lower, upper = ['<link name="base"/>', '<link name="tcp"/>'], {}, {}
    for i, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        ball = shape or f'<sphere radius="{rng.uniform(0.03, 0.08):.4f}"/>'
        origin = f'<origin xyz="{_text(rng, 0.1)}" rpy="{_text(rng, 3.0)}"/>'
        link = f"<collision>{origin}<geometry>{ball}</geometry></collision>"
        elements.append(f'<link name="link{i}">{link}</link>')
        told = rng.choice(["revolute", "continuous", "prismatic"]) if kind == "mimic" else kind
        widest = 1.0 if told == "prismatic" else 30.0
        lower[name], upper[name] = -widest, widest
        more = f'<limit lower="{-widest}" upper="{widest}" velocity="2" effort="9"/>'
        if kind == "mimic":
            factor, leader = rng.choice([-2.0, -1.0, 0.5, 1.0, 3.0]), rng.choice(leaders)
            more += (
                f'<mimic joint="{leader}" multiplier="{factor}" offset="{rng.uniform(-1, 1):.3f}"/>'
            )
            leaders.append(name)
        elements.append(
            f'<joint name="{name}" type="{told}"><parent link="{f"link{i - 1}" if i else "base"}"/>'
            f'<child link="link{i}"/><origin xyz="{_text(rng, 0.25)}" rpy="{_text(rng, 3.0)}"/>'
            f'<axis xyz="{rng.choice(["1 0 0", "0 1 0", "0 0 -1", "1 2 -0.5"])}"/>{more}</joint>'
        )
    elements.append(
        f'<joint name="tip" type="fixed"><parent link="link{len(kinds) - 1}"/><child link="tcp"/>'
        f'<origin xyz="{_text(rng, 0.1)}"/></joint>'
    )
    rng.shuffle(elements)
    return RandomChain(
        urdf=f'<robot name="chain">{"".join(elements)}</robot>',
        kinds=dict(zip(names, kinds, strict=True)),
        lower=lower,
        upper=upper,
    )


def _text(rng: random.Random, widest: float) -> str:
    return " ".join(f"{rng.uniform(-widest, widest):.4f}" for _ in range(3))


def _box_distance(place: F64, lower: F64, upper: F64) -> float:
    outside = np.maximum(np.maximum(lower - place, place - upper), 0.0)
    if outside.any():
        return float(np.linalg.norm(outside))
    return -float(np.minimum(place - lower, upper - place).min())


def _get(element: ElementTree.Element, child: str, name: str, default: str) -> str:
    found = element.find(child)
    return default if found is None else found.get(name, default)


def _numbers(text: str) -> F64:
    return np.array([float(word) for word in text.split()])
