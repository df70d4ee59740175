"""A witness on the robot's graph: the simulator's own state, not what tools or modules report."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from rn_eval.agents.truth import F64, Truth
from rn_robot_fr3.cell import FR3
from roboneuron import Controller, ControllerSpec, JointSample
from roboneuron.command import build, discover, load_config, load_profile

if TYPE_CHECKING:
    from std_msgs.msg import Float64MultiArray
    from trajectory_msgs.msg import JointTrajectory

    from rn_simulation.scene_state import SceneState

ROBOT, CONTROLLER = "fr3", "urdf"
_COMMANDS = f"/{ROBOT}/joint_trajectory"
"""All that moves the simulated arm."""
_ARM = 7
_MOST_SAMPLES = 60 * 900
"""A quarter of an hour: an episode is bounded well below."""
_NEW_SIMULATION_S = 0.4
"""Samples come 60 times a second; after such a gap the cubes decide whether it is a new one."""
_JUMP_M = 0.05


class Aim(NamedTuple):
    """Where the arm was commanded to go.

    Attributes:
        seen_ns: ROS time at which the command was seen [ns].
        joints: position by joint [rad or m].
    """

    seen_ns: int
    joints: dict[str, float]


class Witness:
    """Follows the simulation of `ROBOT` on the ROS domain of this process; used by one thread."""

    def __init__(self) -> None:
        """Load what computes the TCP of a posture; joins nothing yet."""
        registry, config = discover(), load_config(None)
        profile = load_profile(registry, ROBOT)
        spec = registry.get(ControllerSpec, CONTROLLER)
        controller = cast("Controller", build(spec, config.options(CONTROLLER), profile))
        controller.load()
        self._controller = controller
        self._names = profile.arm_joints
        self._lock = threading.Lock()
        self._samples: list[SceneState] = []
        self._aims: list[Aim] = []
        self._link: object | None = None

    def open(self) -> None:
        """Join the graph; `prepare_environment` must have run."""
        from std_msgs.msg import Float64MultiArray  # heavy
        from trajectory_msgs.msg import JointTrajectory  # heavy

        from rn_simulation.scene_state import TOPIC
        from roboneuron.command import RosLink

        link = RosLink("agents_witness")
        link.open()
        link.subscribe(Float64MultiArray, f"/{ROBOT}/{TOPIC}", self._note)
        link.subscribe(JointTrajectory, _COMMANDS, self._note_command)
        self._link = link

    def _note(self, message: Float64MultiArray) -> None:
        from rn_simulation.scene_state import from_message

        state = from_message(message, {FR3.robot: len(FR3.joints)})
        with self._lock:
            if len(self._samples) < _MOST_SAMPLES:
                self._samples.append(state)

    def _note_command(self, message: JointTrajectory) -> None:
        seen_ns = time.time_ns()
        with self._lock:
            for point in message.points:
                if len(self._aims) < _MOST_SAMPLES:
                    joints = dict(zip(message.joint_names, point.positions, strict=True))
                    self._aims.append(Aim(seen_ns, joints))

    def begin(self) -> None:
        """Forget what was seen before."""
        with self._lock:
            self._samples.clear()
            self._aims.clear()

    def truth(self, begun_ns: int, latched_s: tuple[tuple[float, float], ...]) -> Truth:
        """What was seen since `begin`.

        Args:
            begun_ns: start of the agent, ROS time [ns].
            latched_s: see `Truth`.
        """
        with self._lock:
            samples, aims = list(self._samples), list(self._aims)
        truth = to_truth(samples, self._controller, self._names, begun_ns, latched_s)
        aims = [aim for aim in aims if set(self._names) <= aim.joints.keys()]
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
        """A film strip of what was seen since `begin`; see `film_strip`."""
        from rn_eval.agents.films import film_strip

        with self._lock:
            samples = list(self._samples)
        return film_strip(samples, begun_ns)

    def close(self) -> None:
        """Leave the graph; may be called twice."""
        from roboneuron.command import RosLink

        link, self._link = self._link, None
        if isinstance(link, RosLink):
            link.close()
        self._controller.close()


def to_truth(
    samples: list[SceneState],
    controller: Controller,
    names: tuple[str, ...],
    begun_ns: int,
    latched_s: tuple[tuple[float, float], ...],
) -> Truth:
    """Samples of one simulated FR3 as arrays; of several scenes the newest one's cubes are kept."""
    if not samples:
        return Truth(
            t_s=np.zeros(0),
            joints_rad=np.zeros((0, _ARM)),
            finger_m=np.zeros(0),
            tcp_m=np.zeros((0, 3)),
            names=(),
            cubes_m=np.zeros((0, 0, 3)),
            edges_m=np.zeros(0),
            latched_s=latched_s,
        )
    cubes = samples[-1].cubes
    samples = [sample for sample in samples if sample.cubes == cubes]
    joints = np.array([sample.joints for sample in samples])
    tcp = [
        controller.forward(
            JointSample(
                names=names,
                position=sample.joints[:_ARM],
                velocity=np.zeros(_ARM),
                stamp_ns=sample.stamp_ns,
            )
        ).position_m
        for sample in samples
    ]
    t_s = np.array([(sample.stamp_ns - begun_ns) / 1e9 for sample in samples])
    return Truth(
        t_s=t_s,
        joints_rad=joints[:, :_ARM],
        finger_m=joints[:, _ARM],
        tcp_m=np.array(tcp),
        names=tuple(name for name, _ in cubes),
        cubes_m=np.array([sample.cube_poses[:, :3] for sample in samples]),
        edges_m=np.array([edge for _, edge in cubes]),
        latched_s=latched_s,
        starts=_starts(samples, t_s, joints),
    )


def _starts(samples: list[SceneState], t_s: F64, joints: F64) -> tuple[int, ...]:
    """Where a new simulation begins: after a gap, with joints or cubes somewhere else at once."""
    starts = [0]
    for index in range(1, len(samples)):
        if t_s[index] - t_s[index - 1] < _NEW_SIMULATION_S:
            continue
        before, now = samples[index - 1], samples[index]
        jumped = np.abs(now.cube_poses[:, :3] - before.cube_poses[:, :3]).max() > _JUMP_M
        if jumped or np.abs(joints[index] - joints[index - 1]).max() > _JUMP_M:
            starts.append(index)
    return tuple(starts)
