"""Driver of a simulated arm: runs its simulation in real time in a separate thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from std_msgs.msg import Float64, Float64MultiArray

from rn_simulation.arm_cell import STEP_S
from rn_simulation.arm_options import SimulatedArmOptions
from rn_simulation.arm_simulation import CellSimulation
from rn_simulation.ground_truth import told
from rn_simulation.real_time import RealTimeThread
from rn_simulation.scene_state import (
    HANDED_OVER_TOPIC,
    TOPIC,
    SceneState,
    poses_of,
    to_message,
)
from rn_simulation.slip import slips_after_s
from rn_simulation.stepped import (
    CLOCK_TOPIC,
    TURN_TOPIC,
    SteppedTime,
    TurnWord,
    WorldPhase,
    to_clock,
)
from rn_simulation.twin import CellTwin
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
"""Maximum time to catch up after a delay: more would make the TCP jump, faster than its limit by
the wall clock.
"""


class SimulatedArmDriver:
    """Follows the protocol `RobotDriver`; every method may be called from any thread.

    The simulation steps at 240 Hz times `real_time_factor` and publishes its state on the topic
    `sim/state`, from which `SimulatedArmCameras` render images in another process, so rendering
    delays no step.
    """

    def __init__(
        self,
        title: str,
        simulation: CellSimulation,
        options: SimulatedArmOptions,
        profile: RobotProfile,
        topics: Topics,
    ) -> None:
        """Store the arguments; `title` names the robot in messages."""
        self._title = title
        self._simulation = simulation
        self._profile = profile
        self._topics = topics
        self._publish: Callable[[Float64MultiArray], None] | None = None
        self._tell_clock: Callable[[Float64MultiArray], None] | None = None
        self._tell: Callable[[Float64], None] | None = None
        self._cell = simulation.arm_cell
        self.waits_for_commands = options.stepped
        self._stepped = SteppedTime(STEP_S)
        self._time = RealTimeThread(
            title,
            step_s=STEP_S,
            factor=options.real_time_factor,
            publish_rate_hz=options.state_rate_hz,
            catch_up_s=_CATCH_UP_S,
        )
        self._state: RobotState | None = None
        self._detail: dict[str, str] = {}

    def open(self) -> None:
        """Build the scene and start time; the robot is at home with an open gripper.

        Raises:
            ConfigurationError: a window is requested without a display, the profile is another
                robot's, or `slip.SWITCH` is no number.
            NotReadyError: the simulation did not start in time.
            StateError: it is already open.
        """
        self._time.check_stopped()
        if self._profile.arm_joints != self._cell.arm_joints:
            raise ConfigurationError(
                f"The simulated {self._title} has the joints {', '.join(self._cell.arm_joints)}, "
                f"the profile {self._profile.name!r} has {', '.join(self._profile.arm_joints)}."
            )
        if self._publish is None:
            self._publish = self._topics.advertise(TOPIC, Float64MultiArray)
            if len(self._cell.arms) > 1:
                self._tell = self._topics.advertise(HANDED_OVER_TOPIC, Float64)
            if self.waits_for_commands:
                self._tell_clock = self._topics.advertise(CLOCK_TOPIC, Float64MultiArray)
                self._topics.subscribe(TURN_TOPIC, Float64MultiArray, self._take_turn)
        self._stepped = SteppedTime(STEP_S)
        self._simulation.let_slip(slips_after_s())
        self._time.start(self._simulation, self._advance)

    def twin(self) -> CellTwin:
        """Return the twin for simulated calls; the driver must not be open."""
        return CellTwin(self._simulation)

    def read(self) -> RobotState:
        """Return the newest state, measured 120 times per second.

        `detail` holds "sim_time_s", "real_time_factor" (achieved during the last second), "engine",
        and the ground truth if `ground_truth.SWITCH` is on: "cubes" (JSON: position, lifted height
        and held time of each; for several arms also the arms holding it and the time since the
        handover) and "seed".

        Raises:
            StateError: not open.
            UnsafeError: the simulation failed while running.
        """
        self._time.check_running()
        state = self._state
        if state is None:
            raise StateError(f"The simulated {self._title} is not open.")
        return state

    def send(self, command: JointCommand) -> JointCommand:
        """Move towards `command`; it replaces the previous command, without a jump in position or
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
            if self.waits_for_commands and self._rests_at(command):
                return command
            sent = self._simulation.set_target(command.names, command.position, command.duration_s)
            self._stepped.command(command.duration_s, self._topics.now_ns())
        return replace(command, position=sent.position, duration_s=sent.duration_s)

    def hold(self) -> None:
        """Brake the arm to a standstill; the gripper keeps its grasp. Raises as `read`."""
        self._time.check_running()
        with self._time.stepping:
            self._simulation.hold()
            self._stepped.settle(self._topics.now_ns())

    def close(self) -> None:
        """End the simulation; may be called twice and before `open`."""
        self._time.stop()
        self._state = None

    def _take_turn(self, message: Float64MultiArray) -> None:
        """See `TURN_TOPIC`."""
        if np.shape(message.data) != (2,) or not np.isfinite(message.data).all():
            return
        if message.data[0] in list(TurnWord):
            word, count = TurnWord(int(message.data[0])), int(message.data[1])
            with self._time.stepping:
                self._stepped.take_turn(word, count, self._topics.now_ns())

    def _rests_at(self, command: JointCommand) -> bool:
        """Whether the joints of a command rest exactly where it sends them, as after a hold, which
        comes at a wall time.

        It would otherwise move the set points by what the motors are off, at any time.
        """
        state, names = self._state, self._cell.joints
        if state is None or self._stepped.phase is not WorldPhase.RESTING:
            return False
        if not set(command.names) <= set(names):
            return False
        measured = state.joints.position[[names.index(name) for name in command.names]]
        return bool(np.array_equal(measured, command.position))

    def _make(self, due: int) -> bool:
        """Make steps; returns True if that ended a phase of stepped time."""
        stepped, now_ns = self._stepped, self._topics.now_ns
        if not self.waits_for_commands:
            self._simulation.step(due)
            return False
        self._simulation.step(stepped.grant(due, time.monotonic(), now_ns()))
        return stepped.note_made(time.monotonic(), now_ns())

    def _advance(self, steps: int, factor: float, publish: bool) -> None:
        simulation = self._simulation
        with self._time.stepping:
            stands = self._make(steps)
            position, velocity = simulation.joint_states()
            if self.waits_for_commands and self._stepped.phase is WorldPhase.RESTING:
                velocity = np.zeros_like(velocity)  # its time stands
            cubes = simulation.cubes() if publish else None
            is_told = self._tell_clock is not None and (publish or stands)
            clock = to_clock(self._stepped, simulation.time_s) if is_told else None
        stamp_ns = self._topics.now_ns()
        if cubes is not None and self._publish is not None:
            state = SceneState(
                robot=self._cell.robot,
                engine=simulation.engine,
                seed=simulation.seed,
                cubes=tuple((cube.name, cube.edge_m) for cube in cubes.values()),
                joints=position,
                cube_poses=poses_of(cubes),
                stamp_ns=stamp_ns,
            )
            self._publish(to_message(state))
            if self._tell is not None:
                handed_over_s = max(cube.handed_over_s for cube in cubes.values())
                self._tell(Float64(data=handed_over_s))
            self._detail = {
                "sim_time_s": f"{simulation.time_s:.3f}",
                "real_time_factor": f"{factor:.3f}",
                "engine": simulation.engine,
                **told(cubes, simulation.seed),
            }
        self._state = RobotState(
            joints=JointSample(
                names=self._cell.joints, position=position, velocity=velocity, stamp_ns=stamp_ns
            ),
            gripper_open=self._cell.opening(position),
            detail=self._detail,
        )
        if self._tell_clock is not None and clock is not None:
            self._tell_clock(clock)
