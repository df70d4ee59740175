"""Public robots against the controller "urdf": places, distances and steps, judged by other code.

The URDFs of the package example-robot-data, each chain from its root to a link that carries none.
The judge has its own kinematics (rn_testing.robot_judge) and its own shapes: primitives, and hulls
of all vertices of a mesh as trimesh reads it, compared by coal; the triangles of small meshes
decide where hulls are too close. It shares nothing with the controller but coal.

    python benchmarks/robots_sweep.py [--postures 20] [--only ur5 panda] [--folder FOLDER]

Fails unless no contact is missed, no alarm is false beyond `TOLERANCE_M`, and every place agrees to
`SAME_M`. A robot tried alone, by `--only`, gives the same numbers as in a whole run.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import distribution
from pathlib import Path

import numpy as np
from judged_shapes import LEAST_M, JudgedShapes

from rn_controller_urdf.controller import UrdfController
from rn_controller_urdf.options import UrdfControllerOptions
from rn_testing.robot_judge import JudgedRobot
from roboneuron import (
    Action,
    CollisionProfile,
    JointCommand,
    JointSample,
    RoboNeuronError,
    RobotProfile,
    matrix_from_quaternion,
)

SAME_M = 1e-6
TOLERANCE_M = 0.005
"""A hull of many vertices is thickened by what it lacks when it is bounded: no more than this."""
MOVING = ("revolute", "continuous", "prismatic")


@dataclass
class Row:
    """What was seen of chains that hold a kind of joint."""

    chains: int = 0
    postures: int = 0
    farthest_m: float = 0.0
    steps: int = 0
    wrong_steps: int = 0


@dataclass
class Found:
    """What was seen of one robot."""

    pairs: int = 0
    postures: int = 0
    contacts: int = 0
    missed: int = 0
    false: int = 0
    thicker_m: float = 0.0
    home: str = ""
    check_us: float = 0.0
    load_s: float = 0.0
    refused: str = ""


@dataclass(frozen=True)
class Chain:
    """Moving joints from the root of a robot to a link that carries none."""

    tip: str
    joints: tuple[str, ...]
    kinds: frozenset[str]


class Robot:
    """A description, and its chains."""

    def __init__(self, path: Path) -> None:
        self.path, self.urdf = path, path.read_text(encoding="utf-8")
        tree = ElementTree.fromstring(self.urdf)
        self.joints = {j.get("name", ""): j for j in tree.findall("joint")}
        self._above = {_link(j, "child"): j for j in self.joints.values()}
        links = [link.get("name", "") for link in tree.findall("link")]
        roots = [link for link in links if link not in self._above]
        if not roots:
            raise ValueError(f"{path.name} has no root link")
        self.root = roots[0]
        parents = {_link(j, "parent") for j in self.joints.values()}
        self.leaves = [link for link in links if link not in parents]

    def chains(self) -> Iterator[Chain]:
        seen: set[tuple[str, ...]] = set()
        for leaf in self.leaves:
            names: list[str] = []
            kinds: set[str] = set()
            link = leaf
            while link in self._above:
                joint = self._above[link]
                kind = joint.get("type", "")
                if kind in MOVING:
                    is_led = joint.find("mimic") is not None
                    kinds.add("mimic" if is_led else kind)
                    if not is_led:
                        names.append(joint.get("name", ""))
                elif kind != "fixed":
                    kinds.add(kind)
                link = _link(joint, "parent")
            found = tuple(reversed(names))
            if found and found not in seen:
                seen.add(found)
                yield Chain(leaf, found, frozenset(kinds))

    def posture(self, rng: np.random.Generator) -> dict[str, float]:
        """A position of each joint that leads itself; of endless ones within four turns."""
        return {
            name: float(rng.uniform(*self._range(joint)))
            for name, joint in self.joints.items()
            if joint.get("type") in MOVING and joint.find("mimic") is None
        }

    def _range(self, joint: ElementTree.Element) -> tuple[float, float]:
        limit = joint.find("limit")
        widest = 0.3 if joint.get("type") == "prismatic" else 4.0 * math.pi
        if joint.get("type") == "continuous" or limit is None:
            return -widest, widest
        low, high = float(limit.get("lower", "0")), float(limit.get("upper", "0"))
        return max(low, -widest), max(min(high, widest), max(low, -widest))

    def rest(self, joint: str) -> float:
        """0, or the limit nearest to it."""
        low, high = self._range(self.joints[joint])
        return min(max(0.0, low), high)

    def profile(self, chain: Chain | None, collision: CollisionProfile | None) -> RobotProfile:
        return RobotProfile(
            name=self.path.stem,
            urdf=self.urdf,
            base_link=self.root,
            tcp_link=chain.tip if chain else self.root,
            arm_joints=chain.joints if chain else (),
            home_rad=np.array([self.rest(name) for name in chain.joints]) if chain else None,
            collision=collision,
            mesh_folder=str(self.path.parent),
        )


def _link(joint: ElementTree.Element, role: str) -> str:
    found = joint.find(role)
    return "" if found is None else found.get("link", "")


def _sample(posture: Mapping[str, float], rng: np.random.Generator) -> JointSample:
    names = list(posture)
    rng.shuffle(names)
    return JointSample(names=tuple(names), position=np.array([posture[name] for name in names]))


def check_chain(robot: Robot, chain: Chain, postures: int, rng: np.random.Generator) -> Row | str:
    """Places and steps of a chain; or why the controller refuses it."""
    judge, row = JudgedRobot(robot.urdf), Row(chains=1)
    controller = UrdfController(UrdfControllerOptions(track="position"), robot.profile(chain, None))
    try:
        controller.load()
    except RoboNeuronError as error:
        return str(error)
    for _ in range(postures):
        true = robot.posture(rng)
        joints, row.postures = _sample(true, rng), row.postures + 1
        expected = judge.pose(chain.tip, true, robot.root)
        pose = controller.forward(joints)
        off = np.abs(expected[:3, 3] - pose.position_m).max()
        turn = np.abs(expected[:3, :3] - matrix_from_quaternion(pose.quaternion_xyzw)).max()
        row.farthest_m = max(row.farthest_m, float(off), float(turn))
        action = Action(
            translation_m=rng.uniform(-0.005, 0.005, 3), rotation_rad=np.zeros(3), gripper_open=1.0
        )
        command = controller.compute(action, joints, 0.1)
        if isinstance(command, JointCommand):
            row.steps += 1
            moved = {**true, **dict(zip(command.names, command.position.tolist(), strict=True))}
            end = judge.pose(chain.tip, moved, robot.root)[:3, 3]
            off_m = np.linalg.norm(end - expected[:3, 3] - action.translation_m)
            row.wrong_steps += int(off_m > command.residual_m + SAME_M)
    return row


def check_distances(robot: Robot, postures: int, rng: np.random.Generator) -> Found:
    """Every pair that the controller compares, at random postures."""
    found = Found()
    chain = max(robot.chains(), key=lambda chain: len(chain.joints), default=None)
    began_s = time.perf_counter()
    try:
        controller = UrdfController(
            UrdfControllerOptions(track="position"),
            robot.profile(chain, CollisionProfile(min_distance_m=LEAST_M)),
        )
        controller.load()
        found.load_s = time.perf_counter() - began_s
        rest = {name: robot.rest(name) for name in robot.posture(rng)}
        shapes = JudgedShapes(robot.urdf, str(robot.path.parent), rest)
        nearest = controller.distances(_sample(rest, rng))
    except RoboNeuronError as error:
        found.refused = str(error)
        return found
    found.pairs = len(nearest)
    if nearest:
        first = nearest[0]
        found.home = f"{first.distance_m * 1e3:.1f} mm {first.first}-{first.second}"
    spent_s = 0.0
    for _ in range(postures):
        true = robot.posture(rng)
        joints, found.postures = _sample(true, rng), found.postures + 1
        began_s = time.perf_counter()
        near = controller.inspect(joints).near or ()
        spent_s += time.perf_counter() - began_s
        told = {frozenset((pair.first, pair.second)) for pair in near}
        for pair in controller.distances(joints):
            truth_m = shapes.distance(pair.first, pair.second, true, robot.root)
            is_told = frozenset((pair.first, pair.second)) in told
            if truth_m < LEAST_M - SAME_M and not is_told:
                many = [robot.posture(rng) for _ in range(200)]
                shapes.leave_out_together(pair.first, pair.second, many, robot.root)
                truth_m = shapes.distance(pair.first, pair.second, true, robot.root)
            found.contacts += int(truth_m < LEAST_M)
            found.missed += int(truth_m < LEAST_M - SAME_M and not is_told)
            found.false += int(truth_m > LEAST_M + TOLERANCE_M and is_told)
            if truth_m > 0.0:
                found.thicker_m = max(found.thicker_m, truth_m - pair.distance_m)
    found.check_us = spent_s / max(1, found.postures) * 1e6
    return found


def robots(folder: Path, only: list[str]) -> Iterator[Robot]:
    """Every description below a folder; one without a root link is named and left out."""
    for path in sorted(folder.rglob("*.urdf")):
        if only and not any(word in path.name for word in only):
            continue
        try:
            robot = Robot(path)
        except ValueError as error:
            print(f"left out: {error}", file=sys.stderr)
            continue
        yield robot


def installed() -> Path:
    """Folder of the package example-robot-data."""
    for file in distribution("example-robot-data").files or ():
        if file.name.endswith(".urdf"):
            path = Path(str(file.locate()))
            return next(p for p in path.parents if p.name == "robots")
    raise FileNotFoundError("example-robot-data holds no URDF.")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--postures", type=int, default=20)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    rows: dict[str, Row] = defaultdict(Row)
    bad, refused = 0, list[str]()
    print(
        "| robot | pairs | smallest distance at rest | load s | check us | contacts | missed |"
        " false | thicker mm |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for robot in robots(arguments.folder or installed(), arguments.only):
        rng = np.random.default_rng(
            [47, *robot.path.name.encode()]
        )  # so a robot can be tried alone
        for chain in robot.chains():
            row = check_chain(robot, chain, arguments.postures, rng)
            if isinstance(row, str):
                refused.append(f"{robot.path.stem} {chain.tip}: {row}")
                continue
            bad += row.wrong_steps + int(row.farthest_m > SAME_M)
            for kind in (*sorted(chain.kinds), "all"):
                total = rows[kind]
                total.chains += 1
                total.postures += row.postures
                total.steps += row.steps
                total.wrong_steps += row.wrong_steps
                total.farthest_m = max(total.farthest_m, row.farthest_m)
        one = check_distances(robot, arguments.postures, rng)
        if one.refused:
            refused.append(f"{robot.path.stem} distances: {one.refused}")
            continue
        bad += one.missed + one.false
        print(
            f"| {robot.path.stem} | {one.pairs} | {one.home} | {one.load_s:.2f} | "
            f"{one.check_us:.0f} | {one.contacts} | {one.missed} | {one.false} | "
            f"{one.thicker_m * 1e3:.2f} |",
            flush=True,
        )
    print("\n| chains with | chains | postures | farthest m | steps | wrong |")
    print("|---|---|---|---|---|---|")
    for kind, row in rows.items():
        print(
            f"| {kind} | {row.chains} | {row.postures} | {row.farthest_m:.1e} | {row.steps} | "
            f"{row.wrong_steps} |"
        )
    print("\nRefused:", *refused, sep="\n- ")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
