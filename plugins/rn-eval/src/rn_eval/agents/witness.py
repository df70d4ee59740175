"""Witness on the ROS graph: records the simulators' own state, not what tools or modules report."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from rn_eval.agents.base_truth import BaseTruth
from rn_eval.agents.truth import ARM_JOINTS, F64, Truth
from rn_robot_fr3.cell import FR3
from roboneuron import Controller, ControllerSpec, JointSample, PostureInspector, StateError
from roboneuron.command import discover, load_config
from roboneuron.feature import build, load_profile

if TYPE_CHECKING:
    from rn_simulation.scene_state import SceneState
    from roboneuron.command import RosLink

Latches = tuple[tuple[float, float], ...]
"""Latches of a robot's emergency stop, as `Truth.latched_s`."""

ROBOT, CONTROLLER = "fr3", "urdf"
_COMMANDS = "joint_trajectory"
"""The only topic that moves a simulated arm."""
_MOST_SAMPLES = 60 * 900
"""A quarter of an hour at 60 samples per second, far above the time limit of an episode."""
_NEW_SIMULATION_S = 0.4
"""Samples come 60 times a second; after such a gap, a jump of joints or cubes means a new
simulation.
"""
_JUMP_M = 0.05
_LEVEL = 0.7
"""Horizontal part of an axis that is level rather than upright."""
_BOX_EVERY = 6
"""The boxes of the links cost milliseconds, so they are computed ten times a second."""


class Aim(NamedTuple):
    """A motion command to an arm.

    Attributes:
        seen_ns: ROS time at which the command was received [ns].
        joints: position by joint [rad or m].
    """

    seen_ns: int
    joints: dict[str, float]


@dataclass(slots=True)
class _Seen:
    """Samples of one robot."""

    samples: list[SceneState] = field(default_factory=list)
    aims: list[Aim] = field(default_factory=list)
    poses: list[tuple[int, float, float, float]] = field(default_factory=list)


class Witness:
    """Records simulated robots on the ROS domain of this process; used by one thread."""

    def __init__(self) -> None:
        """Load the kinematics for the TCP; does not join the graph yet."""
        registry, config = discover(), load_config(None)
        profile = load_profile(registry, ROBOT)
        spec = registry.get(ControllerSpec, CONTROLLER)
        controller = cast("Controller", build(spec, config.options(CONTROLLER), profile))
        controller.load()
        self._controller = controller
        self._names = profile.arm_joints
        self._lock = threading.Lock()
        self._seen: dict[str, _Seen] = {}
        self._arms: tuple[str, ...] = (ROBOT,)
        self._bases: tuple[str, ...] = ()
        self._link: RosLink | None = None

    def open(self) -> None:
        """Join the graph; `prepare_environment` must have run."""
        from roboneuron.command import RosLink

        link = RosLink("agents_witness")
        link.open()
        self._link = link

    def begin(self, arms: Sequence[str] = (ROBOT,), bases: Sequence[str] = ()) -> None:
        """Clear earlier samples and record these robots; call it while none of them runs. `film`
        and `truth` refer to the first arm.

        Raises:
            StateError: the witness is not open.
        """
        if self._link is None:
            raise StateError("The witness is not open.")
        with self._lock:
            known = set(self._seen)
            self._seen = {name: _Seen() for name in {*known, *arms, *bases}}
            self._arms, self._bases = tuple(arms), tuple(bases)
        for name in arms:
            if name not in known:
                self._follow_arm(self._link, name)
        for name in bases:
            if name not in known:
                self._follow_base(self._link, name)

    def _follow_arm(self, link: RosLink, name: str) -> None:
        from std_msgs.msg import Float64MultiArray  # heavy
        from trajectory_msgs.msg import JointTrajectory  # heavy

        from rn_simulation.scene_state import TOPIC, from_message

        def note(message: Float64MultiArray) -> None:
            state = from_message(message, {FR3.robot: len(FR3.joints)})
            with self._lock:
                samples = self._seen[name].samples
                if len(samples) < _MOST_SAMPLES:
                    samples.append(state)

        def note_command(message: JointTrajectory) -> None:
            seen_ns = time.time_ns()
            with self._lock:
                aims = self._seen[name].aims
                for point in message.points[: _MOST_SAMPLES - len(aims)]:
                    joints = dict(zip(message.joint_names, point.positions, strict=True))
                    aims.append(Aim(seen_ns, joints))

        link.subscribe(Float64MultiArray, f"/{name}/{TOPIC}", note)
        link.subscribe(JointTrajectory, f"/{name}/{_COMMANDS}", note_command)

    def _follow_base(self, link: RosLink, name: str) -> None:
        from nav_msgs.msg import Odometry  # heavy

        from rn_simulation.ground_truth import TRUE_POSE_TOPIC

        def note(message: Odometry) -> None:
            stamp, place = message.header.stamp, message.pose.pose
            yaw_rad = 2.0 * math.atan2(place.orientation.z, place.orientation.w)
            now_ns = stamp.sec * 10**9 + stamp.nanosec
            with self._lock:
                poses = self._seen[name].poses
                if len(poses) < _MOST_SAMPLES:
                    poses.append((now_ns, place.position.x, place.position.y, yaw_rad))

        link.subscribe(Odometry, f"/{name}/{TRUE_POSE_TOPIC}", note)

    def truth(self, begun_ns: int, latched_s: Mapping[str, Latches]) -> Truth:
        """Return the samples since `begin`.

        Args:
            begun_ns: start of the agent, ROS time [ns].
            latched_s: latches of each robot, see `Truth`.
        """
        with self._lock:
            arms = {name: _copy(self._seen[name]) for name in self._arms}
            bases = {name: list(self._seen[name].poses) for name in self._bases}
        found = {
            name: self._of_arm(seen, begun_ns, latched_s.get(name, ()))
            for name, seen in arms.items()
        }
        return replace(
            found.pop(self._arms[0]),
            others=found,
            bases={
                name: _of_base(poses, begun_ns, latched_s.get(name, ()))
                for name, poses in bases.items()
            },
        )

    def _of_arm(self, seen: _Seen, begun_ns: int, latched_s: Latches) -> Truth:
        truth = to_truth(seen.samples, self._controller, self._names, begun_ns, latched_s)
        aims = [aim for aim in seen.aims if set(self._names) <= aim.joints.keys()]
        if not aims:
            return truth
        places = [
            self._controller.forward(
                JointSample(
                    names=self._names,
                    position=np.array([aim.joints[name] for name in self._names]),
                    stamp_ns=aim.seen_ns,
                )
            ).position_m
            for aim in aims
        ]
        return replace(
            truth,
            aimed_s=np.array([(aim.seen_ns - begun_ns) / 1e9 for aim in aims]),
            aimed_m=np.array(places),
        )

    def film(self, begun_ns: int) -> bytes:
        """Film strip of the samples since `begin`; see `film_strip`."""
        from rn_eval.agents.films import film_strip

        with self._lock:
            samples = list(self._seen[self._arms[0]].samples) if self._seen else []
        return film_strip(samples, begun_ns)

    def close(self) -> None:
        """Leave the graph; may be called twice."""
        link, self._link = self._link, None
        if link is not None:
            link.close()
        self._controller.close()


def _copy(seen: _Seen) -> _Seen:
    return _Seen(samples=list(seen.samples), aims=list(seen.aims))


def _of_base(
    poses: Sequence[tuple[int, float, float, float]], begun_ns: int, latched_s: Latches
) -> BaseTruth:
    values = np.array(poses, dtype=np.float64).reshape(-1, 4)
    planar = values[:, 1:].copy()
    planar[:, 2] = np.unwrap(planar[:, 2])
    times_s = np.array([(stamp_ns - begun_ns) / 1e9 for stamp_ns, *_ in poses])
    return BaseTruth(t_s=times_s, poses=planar, latched_s=latched_s)


def to_truth(
    samples: list[SceneState],
    controller: Controller,
    names: tuple[str, ...],
    begun_ns: int,
    latched_s: Latches,
) -> Truth:
    """Convert samples of one simulated FR3 to arrays; of several scenes, only the newest one's
    cubes are kept.
    """
    if not samples:
        return Truth.nothing(latched_s)
    cubes = samples[-1].cubes
    samples = [sample for sample in samples if sample.cubes == cubes]
    joints = np.array([sample.joints for sample in samples])
    measured = [
        JointSample(
            names=names,
            position=sample.joints[:ARM_JOINTS],
            velocity=np.zeros(ARM_JOINTS),
            stamp_ns=sample.stamp_ns,
        )
        for sample in samples
    ]
    tcp = [controller.forward(sample).position_m for sample in measured]
    poses = np.array([sample.cube_poses for sample in samples])
    t_s = np.array([(sample.stamp_ns - begun_ns) / 1e9 for sample in samples])
    return Truth(
        t_s=t_s,
        joints_rad=joints[:, :ARM_JOINTS],
        finger_m=joints[:, ARM_JOINTS],
        tcp_m=np.array(tcp),
        names=tuple(name for name, _ in cubes),
        cubes_m=poses[:, :, :3],
        edges_m=np.array([edge for _, edge in cubes]),
        yaws_rad=_yaws_rad(poses[:, :, 3:]),
        arm_m=_boxes_m(controller, measured),
        latched_s=latched_s,
        starts=_starts(samples, t_s, joints),
    )


def _yaws_rad(quaternions: F64) -> F64:
    """Direction about the vertical of the face whose normal is nearest to the horizontal x axis of
    each cube, from x y z w: a cube may lie on any face.
    """
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    first = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w)], axis=-1)
    second = np.stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z)], axis=-1)
    is_upright = np.linalg.norm(first, axis=-1) >= _LEVEL
    ahead = np.arctan2(first[..., 1], first[..., 0])
    aside = np.arctan2(second[..., 1], second[..., 0]) - np.pi / 2
    return np.asarray(np.where(is_upright, ahead, aside))


def _boxes_m(controller: Controller, measured: Sequence[JointSample]) -> F64:
    """`Truth.arm_m`; samples between those that are computed have the box of the one before."""
    assert isinstance(controller, PostureInspector)
    boxes = []
    for sample in measured[::_BOX_EVERY]:
        extents = controller.inspect(sample).extents
        assert extents is not None
        links = extents()
        boxes.append([links.lower_m.min(axis=0), links.upper_m.max(axis=0)])
    return np.array(boxes)[np.arange(len(measured)) // _BOX_EVERY]


def _starts(samples: list[SceneState], t_s: F64, joints: F64) -> tuple[int, ...]:
    """Indices where a new simulation begins: after a gap, with a jump of joints or cubes."""
    starts = [0]
    for index in range(1, len(samples)):
        if t_s[index] - t_s[index - 1] < _NEW_SIMULATION_S:
            continue
        before, now = samples[index - 1], samples[index]
        jumped = np.abs(now.cube_poses[:, :3] - before.cube_poses[:, :3]).max() > _JUMP_M
        if jumped or np.abs(joints[index] - joints[index - 1]).max() > _JUMP_M:
            starts.append(index)
    return tuple(starts)
