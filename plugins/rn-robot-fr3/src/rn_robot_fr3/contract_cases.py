"""Cases of the robot and its cameras for the contract kit; loaded by the kit only."""

from __future__ import annotations

from std_msgs.msg import Float64MultiArray

from rn_robot_fr3.cell import FR3, PAIR, Workcell
from rn_robot_fr3.plugin import roboneuron_perceptions, roboneuron_robots
from rn_robot_fr3.profile import pair_profile, profile
from rn_robot_fr3.scene import random_cubes
from rn_robot_fr3.simulated_cell import arm_cell
from rn_simulation.engine import choose_engine
from rn_simulation.scene_state import TOPIC, SceneState, at_rest, to_message
from rn_testing.cases import PerceptionCase, RobotCase
from rn_testing.fakes import MemoryTopics


def state_at_home(seed: int, stamp_ns: int, cell: Workcell = FR3) -> Float64MultiArray:
    """Message of the simulation to its cameras before any motion."""
    cubes, arms = random_cubes(seed), arm_cell(cell)
    return to_message(
        SceneState(
            robot=cell.robot,
            engine=choose_engine("auto"),
            seed=seed,
            cubes=tuple((cube.name, cube.edge_m) for cube in cubes),
            joints=arms.start[list(arms.followed)],
            cube_poses=at_rest(cubes),
            stamp_ns=stamp_ns,
        )
    )


def _feed(source: object, topics: MemoryTopics) -> None:
    topics.deliver(TOPIC, state_at_home(0, topics.now_ns()))


def robot_case() -> RobotCase:
    """The robot with its simulated driver."""
    return RobotCase(spec=roboneuron_robots()[0], driver="simulated")


def cameras_case() -> PerceptionCase:
    """The simulated cameras, fed with the scene at rest."""
    return PerceptionCase(
        spec=roboneuron_perceptions()[0], cameras=lambda: profile().cameras, feed=_feed
    )


def _feed_pair(source: object, topics: MemoryTopics) -> None:
    topics.deliver(TOPIC, state_at_home(0, topics.now_ns(), PAIR))


def pair_case() -> RobotCase:
    """Two arms with their simulated driver."""
    return RobotCase(spec=roboneuron_robots()[1], driver="simulated")


def pair_cameras_case() -> PerceptionCase:
    """Their simulated cameras, fed with the scene at rest."""
    return PerceptionCase(
        spec=roboneuron_perceptions()[1], cameras=lambda: pair_profile().cameras, feed=_feed_pair
    )
