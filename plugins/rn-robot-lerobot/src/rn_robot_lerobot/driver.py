"""The driver `simulated`: runs the simulation in real time in a thread of its own."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from std_msgs.msg import Float64MultiArray

from rn_robot_lerobot.arm import ARM_JOINTS, JOINTS
from rn_robot_lerobot.options import SimulatedDriverOptions
from rn_robot_lerobot.simulation import So101Simulation, opening
from rn_robot_lerobot.state_message import TOPIC, SceneState, to_message
from rn_robot_lerobot.world import STEP_S
from rn_simulation.real_time import RealTimeThread
from roboneuron import (
    ConfigurationError,
    JointCommand,
    JointSample,
    RobotProfile,
    RobotState,
    StateError,
    Topics,
)

_CATCH_UP_S = 1.0 / 60.0
"""An arm whose time was held up does not jump: by the wall clock its TCP would be faster than its
limit.
"""


class SimulatedDriver:
    """Follows the protocol `RobotDriver`; every method may be called from any thread.

    The simulation tells its state on the topic `sim/state`, from which `SimulatedCameras` draws its
    pictures in another process: no picture delays a step.
    """

    def __init__(
        self, config: SimulatedDriverOptions | None, profile: RobotProfile, topics: Topics
    ) -> None:
        """Remember what to simulate."""
        self._options = config or SimulatedDriverOptions()
        self._profile = profile
        self._topics = topics
        self._publish: Callable[[Float64MultiArray], None] | None = None
        self._simulation = So101Simulation(self._options.seed, colours=self._options.colours)
        self._time = RealTimeThread(
            "SO-101",
            step_s=STEP_S,
            factor=self._options.real_time_factor,
            publish_rate_hz=self._options.state_rate_hz,
            catch_up_s=_CATCH_UP_S,
        )
        self._state: RobotState | None = None
        self._detail: dict[str, str] = {}

    def open(self) -> None:
        """Build the scene and let time run; the robot stands at home with an open gripper.

        Raises:
            ConfigurationError: the profile is another robot's.
            NotReadyError: the simulation did not start in time.
            StateError: it is open already.
        """
        self._time.check_stopped()
        if self._profile.arm_joints != ARM_JOINTS:
            raise ConfigurationError(
                f"The simulated SO-101 moves {', '.join(ARM_JOINTS)}, the profile "
                f"{self._profile.name!r} has others."
            )
        if self._publish is None:
            self._publish = self._topics.advertise(TOPIC, Float64MultiArray)
        self._time.start(self._simulation, self._advance)

    def read(self) -> RobotState:
        """Return the newest state, measured 120 times per second.

        `detail` holds "cubes" (JSON: position, height lifted and seconds held of each: the
        simulator's truth), "sim_time_s", "real_time_factor" (achieved during the last second) and
        "seed".

        Raises:
            StateError: not open.
            UnsafeError: the simulation failed while running.
        """
        self._time.check_running()
        state = self._state
        if state is None:
            raise StateError("The simulated SO-101 is not open.")
        return state

    def send(self, command: JointCommand) -> JointCommand:
        """Move towards `command`; it replaces the one before, without a jump in position or
        velocity.

        Returns:
            The command with positions clamped to the limits and the duration that velocity and
            acceleration allow.

        Raises:
            InvalidInputError: an unknown joint, a wrong size, a non-finite value, a duration <= 0;
                nothing is sent.
            StateError, UnsafeError: as `read`.
        """
        self._time.check_running()
        with self._time.stepping:
            sent = self._simulation.set_target(command.names, command.position, command.duration_s)
        return replace(command, position=sent.position, duration_s=sent.duration_s)

    def hold(self) -> None:
        """Brake the arm to a standstill; the gripper keeps its grasp. Raises as `read`."""
        self._time.check_running()
        with self._time.stepping:
            self._simulation.hold()

    def close(self) -> None:
        """End the simulation; may be called twice and before `open`."""
        self._time.stop()
        self._state = None

    def _advance(self, steps: int, factor: float, publish: bool) -> None:
        simulation = self._simulation
        with self._time.stepping:
            simulation.step(steps)
            position, velocity = simulation.joint_states()
            cubes = simulation.cubes() if publish else None
        stamp_ns = self._topics.now_ns()
        if cubes is not None and self._publish is not None:
            poses = [
                np.concatenate([cube.position_m, cube.quaternion_xyzw]) for cube in cubes.values()
            ]
            state = SceneState(
                cubes=tuple((cube.name, cube.edge_m) for cube in cubes.values()),
                joints=position,
                cube_poses=np.array(poses),
                stamp_ns=stamp_ns,
            )
            self._publish(to_message(state))
            facts = {
                name: {
                    "position_m": [round(float(value), 4) for value in cube.position_m],
                    "lifted_m": round(cube.lifted_m, 4),
                    "held_s": round(cube.held_s, 3),
                }
                for name, cube in cubes.items()
            }
            self._detail = {
                "cubes": json.dumps(facts, separators=(",", ":")),
                "sim_time_s": f"{simulation.time_s:.3f}",
                "real_time_factor": f"{factor:.3f}",
                "seed": str(simulation.seed),
            }
        self._state = RobotState(
            joints=JointSample(
                names=JOINTS, position=position, velocity=velocity, stamp_ns=stamp_ns
            ),
            gripper_open=opening(position),
            detail=self._detail,
        )
