"""The driver `simulated`: runs a simulated base in real time in a separate thread."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry

from rn_robot_bases.options import SimulatedBaseOptions
from rn_robot_bases.platform import PLATFORMS
from rn_robot_bases.profile import endpoints
from rn_robot_bases.simulation import STEP_S, BaseSimulation, BaseState
from rn_simulation.ground_truth import TRUE_POSE_TOPIC, is_told
from rn_simulation.planar_motion import to_message
from rn_simulation.real_time import RealTimeThread
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    JointCommand,
    JointSample,
    RefusedError,
    RobotProfile,
    RobotState,
    StateError,
    Topics,
)
from roboneuron.direct_path.twists import check_twist

_CATCH_UP_S = 0.2
"""Maximum time that the simulation catches up after a pause of the machine; less than the
deadman.
"""


class SimulatedBase:
    """Follows the protocol `RobotDriver`; every method may be called from any thread.

    It receives velocities on `cmd_vel` and publishes odometry on `odom`. A twist that the base
    cannot execute is refused as a whole, and the base brakes, because its sender is wrong about the
    robot. The deadman counts simulated time, the base's own clock, which runs with the wall clock
    unless the machine is overloaded.
    """

    def __init__(
        self, config: SimulatedBaseOptions | None, profile: RobotProfile, topics: Topics
    ) -> None:
        """Store the arguments."""
        self._options = config or SimulatedBaseOptions()
        self._profile = profile
        self._topics = topics
        self._simulation: BaseSimulation | None = None
        self._publish: Callable[[Odometry], None] | None = None
        self._tell_truth: Callable[[Odometry], None] | None = None
        self._time = RealTimeThread(
            profile.name,
            step_s=STEP_S,
            catch_up_s=_CATCH_UP_S,
            publish_rate_hz=self._options.odometry_rate_hz,
        )
        self._newest: tuple[BaseState, int] | None = None
        self._refusal = ""
        self._refusals = 0

    def open(self) -> None:
        """Put the base on the floor, at rest, and start time.

        Raises:
            ConfigurationError: the profile is not of this package, or the engine is not installed.
            NotReadyError: the simulation did not start in time.
            StateError: it is already open.
        """
        name = self._profile.name
        self._time.check_stopped()
        if name not in PLATFORMS:
            raise ConfigurationError(
                f"There is no simulated base {name!r}, expected one of {', '.join(PLATFORMS)}."
            )
        self._simulation = BaseSimulation(
            PLATFORMS[name],
            command_timeout_s=self._options.command_timeout_s,
            engine=self._options.engine,
        )
        self._newest = None
        self._refusal, self._refusals = "", 0
        self._factor = 0.0
        if self._publish is None:
            velocity, odometry = endpoints(PLATFORMS[name])
            self._publish = self._topics.advertise(odometry.topic, Odometry)
            self._tell_truth = self._topics.advertise(TRUE_POSE_TOPIC, Odometry)
            self._topics.subscribe(velocity.topic, Twist, self._on_twist)
        self._time.start(self._simulation, self._advance)

    def read(self) -> RobotState:
        """Return the newest state: joints are wheels and steering hinges.

        `detail` contains "odometry" (JSON: x_m, y_m, yaw_rad), "true_pose" in the same form if
        `rn_simulation.ground_truth.SWITCH` is on, "motion" (driving, standing, or stopping with the
        reason), "sim_time_s", "real_time_factor" (achieved during the last second), "engine", and
        "refused" and "refused_count" of velocity commands.

        Raises:
            StateError: not open.
            UnsafeError: the simulation failed while running.
        """
        simulation = self._running()
        newest = self._newest
        if newest is None:
            raise StateError(f"The simulated {self._profile.name} is not open.")
        state, stamp_ns = newest
        return RobotState(
            joints=JointSample(
                names=tuple(state.joint_position),
                position=np.array(list(state.joint_position.values())),
                velocity=np.array(list(state.joint_velocity.values())),
                stamp_ns=stamp_ns,
            ),
            detail={
                "odometry": state.odometry.described(),
                "motion": state.motion,
                "engine": simulation.engine,
                "sim_time_s": f"{state.time_s:.3f}",
                "real_time_factor": f"{self._factor:.3f}",
                "refused": self._refusal,
                "refused_count": str(self._refusals),
                **({"true_pose": state.true_pose.described()} if is_told() else {}),
            },
        )

    def send(self, command: JointCommand) -> JointCommand:
        """Raise InvalidInputError: a base takes no joint positions."""
        raise InvalidInputError(
            f"A mobile base is driven by cmd_vel, {self._profile.name} takes no joint command.",
            hint="Publish geometry_msgs/Twist on cmd_vel.",
        )

    def hold(self) -> None:
        """Brake to a standstill. Raises as `read`."""
        simulation = self._running()
        with self._time.stepping:
            simulation.hold()

    def close(self) -> None:
        """End the simulation; may be called twice and before `open`."""
        self._time.stop()
        self._newest = None

    def _on_twist(self, message: Twist) -> None:
        """Called by the host's executor; it must not raise."""
        simulation = self._simulation
        if simulation is None or not self._time.is_running:
            return
        with self._time.stepping:
            try:
                check_twist(endpoints(simulation.platform)[0], message)
                simulation.drive(message.linear.x, message.angular.z)
            except RefusedError as error:
                simulation.hold("a command was refused")
                self._refusal = str(error)
                self._refusals += 1
            else:
                self._refusal = ""

    def _running(self) -> BaseSimulation:
        self._time.check_running()
        assert self._simulation is not None
        return self._simulation

    def _advance(self, steps: int, factor: float, publish: bool) -> None:
        simulation = self._simulation
        assert simulation is not None
        self._factor = factor
        with self._time.stepping:
            simulation.step(steps)
            state = simulation.state()
        stamp_ns = self._topics.now_ns()
        self._newest = (state, stamp_ns)
        for tell, pose in (
            (self._publish, state.odometry),
            (self._tell_truth, state.true_pose),
        ):
            if publish and tell is not None:
                link = self._profile.base_link
                tell(to_message(pose, state.velocity, stamp_ns=stamp_ns, base_link=link))
