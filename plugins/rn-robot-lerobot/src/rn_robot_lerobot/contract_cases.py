"""Cases of the robot and its cameras for the contract kit; loaded by the kit only."""

from __future__ import annotations

from std_msgs.msg import Float64MultiArray

from rn_robot_lerobot.arm import SO101
from rn_robot_lerobot.plugin import roboneuron_perceptions, roboneuron_robots
from rn_robot_lerobot.profile import so101_profile
from rn_robot_lerobot.scene import random_cubes
from rn_robot_lerobot.simulation import CELL
from rn_simulation.scene_state import TOPIC, SceneState, at_rest, to_message
from rn_testing.cases import PerceptionCase, RobotCase
from rn_testing.fakes import MemoryTopics


def state_at_home(seed: int, stamp_ns: int) -> Float64MultiArray:
    """Message of the simulation to its cameras before any motion."""
    cubes = random_cubes(seed)
    return to_message(
        SceneState(
            robot=SO101.name,
            engine="mujoco",
            seed=seed,
            cubes=tuple((cube.name, cube.edge_m) for cube in cubes),
            joints=CELL.start,
            cube_poses=at_rest(cubes),
            stamp_ns=stamp_ns,
        )
    )


def so101_case() -> RobotCase:
    """The robot with its simulated driver."""
    return RobotCase(spec=roboneuron_robots()[0], driver="simulated")


def koch_case() -> RobotCase:
    """The Koch arm, without a driver to move, because it has no simulation."""
    return RobotCase(spec=roboneuron_robots()[1], driver=None)


def lekiwi_case() -> RobotCase:
    """The LeKiwi, also without a driver to move."""
    return RobotCase(spec=roboneuron_robots()[2], driver=None)


def cameras_case() -> PerceptionCase:
    """The simulated cameras, fed with the scene at rest."""

    def feed(source: object, topics: MemoryTopics) -> None:
        topics.deliver(TOPIC, state_at_home(0, topics.now_ns()))

    return PerceptionCase(
        spec=roboneuron_perceptions()[0], cameras=lambda: so101_profile().cameras, feed=feed
    )
