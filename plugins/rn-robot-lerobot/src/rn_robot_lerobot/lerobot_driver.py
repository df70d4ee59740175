"""The driver `lerobot`: any arm of LeRobot, in lerobot's environment."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rn_robot_lerobot.lerobot_arm import (
    LerobotRobot,
    calibration_of,
    connect,
    make_robot,
    map_motors,
)
from rn_robot_lerobot.lerobot_options import LerobotDriverOptions
from rn_robot_lerobot.units import MotorMap
from rn_simulation.command import checked
from rn_simulation.setpoint import JointSetpoint
from roboneuron import (
    JointCommand,
    JointSample,
    NotReadyError,
    RoboNeuronError,
    RobotProfile,
    RobotState,
    StateError,
    Topics,
    UnsafeError,
)

F64 = NDArray[np.float64]

FAULT = "fault"
"""Key of `RobotState.detail`: the fault that stopped the arm; robot and control then need a new
start.
"""
_GRIPPER_VELOCITY_RAD_S, _GRIPPER_ACCELERATION_RAD_S2 = 3.0, 20.0
_HASTE, _SLACK_RAD = 2.0, 0.15
"""Factor on a joint's velocity limit, and tolerance, for its motion between two readings: a motor
without load is faster than the limit, and on a busy machine readings come in bunches.
"""
_DOUBTS = 3
"""Number of consecutive implausible readings that count as a fault; fewer are ignored."""
_REMEMBERED_S = 1.0
"""Time for which a fault is still reported after its end, so that it is not missed."""
_FAILURES = (OSError, RuntimeError, LookupError, TypeError, ValueError)
"""Exceptions that a robot's class may raise during operation, from the bus or from its own
errors.
"""
_CLIPPED = 1e-3
"""Difference from which a goal counts as changed by LeRobot, as a share of a unit."""
_JOIN_S = 5.0


class LerobotDriver:
    """Follows the protocol `RobotDriver`; every method may be called from any thread.

    One thread owns the bus: it reads, checks the readings, moves the setpoints within the profile's
    limits and sends them. A motor keeps its last goal, so an arm whose driver ends stays at its
    last goal.
    """

    def __init__(
        self, config: LerobotDriverOptions | None, profile: RobotProfile, topics: Topics
    ) -> None:
        """Store the arguments."""
        self._options = config or LerobotDriverOptions()
        self._profile = profile
        self._topics = topics
        self._robot: LerobotRobot | None = None
        self._motors: MotorMap | None = None
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        # guards the following attributes; the bus is used without it
        self._lock = threading.Lock()
        self._setpoint: JointSetpoint | None = None
        self._position, self._velocity = np.empty(0), np.empty(0)
        self._stamp_ns = 0
        self._read_s = 0.0
        self._is_commanded = False
        self._doubts = self._clipped = self._failures = 0
        self._fault, self._fault_s = "", 0.0

    def open(self) -> None:
        """Connect; the arm holds its position once it is commanded.

        Raises:
            StateError: it is already open.
            MissingDependencyError, ConfigurationError, NotReadyError: as the functions of
                `lerobot_arm`; or the first reading failed.
        """
        if self._thread is not None:
            raise StateError("The driver 'lerobot' is open already.")
        options = self._options
        robot = make_robot(options)
        calibration = calibration_of(robot, options)
        motors = map_motors(robot, options, self._profile, calibration)
        connect(robot, options)
        try:
            self._connected(robot)
            position = motors.measured(robot.get_observation())
        except RoboNeuronError:
            self._disconnect(robot)
            raise
        except (OSError, RuntimeError) as error:
            self._disconnect(robot)
            words = " ".join(str(error).split())
            raise NotReadyError(f"The first reading of the arm failed: {words}") from error
        self._robot, self._motors = robot, motors
        self._setpoint = self._setpoint_at(position, motors)
        self._take(position, time.monotonic(), np.zeros_like(position))
        self._ending.clear()
        self._thread = threading.Thread(target=self._run, name="lerobot-bus", daemon=True)
        self._thread.start()

    def read(self) -> RobotState:
        """The newest state; its stamp is that of the measurement, even while the bus is silent.

        `detail` contains "fault" (empty for none), "clipped" (goals that `max_relative_target` has
        shortened) and "bus_errors". Raises StateError unless open.
        """
        motors, position, velocity, stamp_ns, fault = self._newest()
        gripper = self._profile.gripper
        joints = JointSample(
            names=motors.joints, position=position, velocity=velocity, stamp_ns=stamp_ns
        )
        return RobotState(
            joints=joints,
            gripper_open=None if gripper is None else gripper.opening_in(joints),
            detail={
                FAULT: fault,
                "clipped": str(self._clipped),
                "bus_errors": str(self._failures),
            },
        )

    def send(self, command: JointCommand) -> JointCommand:
        """Move towards `command`, within the profile's limits.

        Returns:
            The command with positions clamped to the limits and the duration that velocity and
            acceleration allow.

        Raises:
            StateError: not open.
            InvalidInputError: an unknown joint, a wrong size, a non-finite value, a duration <= 0.
            UnsafeError: a fault has stopped the arm; nothing is sent.
        """
        motors = self._open_motors()
        checked(command, motors.joints)
        lower, upper = self._bounds(motors)
        places = [motors.joints.index(name) for name in command.names]
        with self._lock:
            fault, setpoint = self._told_fault(), self._setpoint
            if fault or setpoint is None:
                raise UnsafeError(f"The arm is held by a fault: {fault}.")
            target = setpoint.target.copy()
            target[places] = np.clip(command.position, lower[places], upper[places])
            possible_s = max(command.duration_s, setpoint.shortest_s(target, places))
            setpoint.aim(target, places, command.duration_s)
            self._is_commanded = True
        return replace(command, position=target[places], duration_s=possible_s)

    def hold(self) -> None:
        """Brake the arm to a standstill; the gripper keeps its grasp. Raises StateError unless
        open.
        """
        self._open_motors()
        with self._lock:
            self._halt()

    def close(self) -> None:
        """Disconnect; the motors keep their torque unless `release_on_close`. May be called twice
        and before `open`.
        """
        self._ending.set()
        thread, self._thread = self._thread, None
        robot, self._robot = self._robot, None
        if thread is not None:
            thread.join(_JOIN_S)
        if robot is not None:
            try:
                self._disconnect(robot)
            except (OSError, RuntimeError) as error:
                raise UnsafeError(f"The bus did not answer to the end: {error}.") from error
            finally:
                self._motors = None

    @property
    def is_open(self) -> bool:
        """True between `open` and `close`."""
        return self._thread is not None

    def _connected(self, robot: LerobotRobot) -> None:
        """Called when the bus is open, before any other use of the robot."""

    def _disconnect(self, robot: LerobotRobot) -> None:
        """Last use of the robot."""
        if robot.is_connected:
            robot.disconnect()

    def _observe(self, observed: Mapping[str, float]) -> None:
        """Process the robot's observations other than joints.

        Raises:
            InvalidInputError: a value is missing.
        """

    def _send_goals(
        self, robot: LerobotRobot, goals: Mapping[str, float], period_s: float
    ) -> Mapping[str, float]:
        """Send goals by key, or nothing if there are none; return the goals really sent."""
        return robot.send_action(dict(goals)) if goals else {}

    def _begin(self) -> None:
        """Hold the arm at its measured position, unless it is commanded; the lock is held."""
        if not self._is_commanded and self._motors is not None:
            self._setpoint = self._setpoint_at(self._position, self._motors)
            self._is_commanded = True

    def _open_motors(self) -> MotorMap:
        if self._motors is None or self._thread is None:
            raise StateError("The driver 'lerobot' is not open.")
        return self._motors

    def _newest(self) -> tuple[MotorMap, F64, F64, int, str]:
        motors = self._open_motors()
        with self._lock:
            newest = self._position.copy(), self._velocity.copy(), self._stamp_ns
            return motors, *newest, self._told_fault()

    def _setpoint_at(self, position: F64, motors: MotorMap) -> JointSetpoint:
        velocity, acceleration = self._speeds(motors)
        return JointSetpoint(position, velocity, acceleration)

    def _speeds(self, motors: MotorMap) -> tuple[F64, F64]:
        """Limits of velocity and acceleration in the order of the motors' joints."""
        limits = self._profile.limits
        velocity = np.full(len(motors.joints), _GRIPPER_VELOCITY_RAD_S)
        acceleration = np.full(len(motors.joints), _GRIPPER_ACCELERATION_RAD_S2)
        for row, joint in enumerate(self._profile.arm_joints):
            place = motors.joints.index(joint)
            if limits is not None:
                velocity[place] = limits.velocity[row]
                acceleration[place] = limits.acceleration[row]
        return velocity, acceleration

    def _bounds(self, motors: MotorMap) -> tuple[F64, F64]:
        """Position limits in the order of the motors' joints."""
        lower = np.full(len(motors.joints), -np.inf)
        upper = np.full(len(motors.joints), np.inf)
        limits = self._profile.limits
        for row, joint in enumerate(self._profile.arm_joints):
            if limits is not None:
                place = motors.joints.index(joint)
                lower[place], upper[place] = limits.lower[row], limits.upper[row]
        for gripper in self._profile.grippers:
            place = motors.joints.index(gripper.joint)
            ends = gripper.closed_position, gripper.open_position
            lower[place], upper[place] = min(ends), max(ends)
        return lower, upper

    def _take(self, position: F64, now_s: float, velocity: F64) -> None:
        self._position, self._velocity = position, velocity
        self._stamp_ns, self._read_s = self._topics.now_ns(), now_s

    def _told_fault(self) -> str:
        """The fault, also shortly after its end; the lock is held."""
        is_recent = time.monotonic() - self._fault_s < _REMEMBERED_S
        return self._fault if is_recent else ""

    def _note_fault(self, fault: str) -> None:
        """Hold the arm because of a fault; the lock is held."""
        self._fault, self._fault_s = fault, time.monotonic()
        self._halt()

    def _halt(self) -> None:
        setpoint, motors = self._setpoint, self._motors
        if setpoint is not None and motors is not None:
            grippers = {gripper.joint for gripper in self._profile.grippers}
            setpoint.halt([i for i, name in enumerate(motors.joints) if name not in grippers])

    def _run(self) -> None:
        period_s = 1.0 / self._options.rate_hz
        next_s = time.monotonic()
        while not self._ending.is_set():
            self._turn(period_s)
            next_s = max(next_s + period_s, time.monotonic() - period_s)
            self._ending.wait(max(0.0, next_s - time.monotonic()))

    def _turn(self, period_s: float) -> None:
        """One cycle: read, check, advance, send."""
        robot, motors = self._robot, self._motors
        if robot is None or motors is None:
            return
        try:
            observed = robot.get_observation()
            told = motors.measured(observed)
            self._observe(observed)
        except (RoboNeuronError, *_FAILURES) as error:
            self._note_silence(robot, error)
            return
        goal, wanted = self._judge(told, period_s), {}
        if goal is not None:
            wanted = motors.values(dict(zip(motors.joints, goal.tolist(), strict=True)))
        try:
            sent = self._send_goals(robot, wanted, period_s)
        except _FAILURES as error:
            self._note_silence(robot, error)
            return
        if any(abs(float(sent[key]) - value) > _CLIPPED for key, value in wanted.items()):
            self._note_clipped(motors.measured(sent))

    def _note_silence(self, robot: LerobotRobot, error: Exception) -> None:
        """Count another failure of the bus; a long enough silence is a fault."""
        with self._lock:
            self._failures += 1
            silent_s = time.monotonic() - self._read_s
            if silent_s > self._options.silence_s:
                where = self._options.port or self._options.type
                words = " ".join(str(error).split())
                self._note_fault(f"the motor bus {where} is silent: {words}")

    def _judge(self, told: F64, period_s: float) -> F64 | None:
        """Process a reading; return the goal to send, or None for nothing.

        After a silence the arm keeps its position: the goal from before it is dropped.
        """
        now_s = time.monotonic()
        with self._lock:
            setpoint, motors = self._setpoint, self._motors
            if setpoint is None or motors is None:
                return None
            since_s = now_s - self._read_s
            was_silent = since_s > self._options.silence_s
            farthest = _HASTE * self._speeds(motors)[0] * since_s + _SLACK_RAD
            excess = np.abs(told - self._position) - farthest
            if not was_silent and excess.max() > 0.0:
                self._doubts += 1
                if self._doubts < _DOUBTS:
                    return None
                place = int(excess.argmax())
                self._note_fault(
                    f"motor {motors.units[place].motor!r} reports {told[place]:.3f}, "
                    f"{abs(told[place] - self._position[place]):.3f} rad from where it was; no "
                    "motor is that fast"
                )
                was_silent = True
            self._doubts = 0
            self._take(told, now_s, (told - self._position) / max(since_s, 1e-3))
            if was_silent:
                # the motors keep their last goals until motion is requested again
                self._setpoint = self._setpoint_at(told, motors)
                self._is_commanded = False
            if not self._is_commanded:
                return None
            setpoint.advance(min(since_s, 2.0 * period_s))
            return self._near(setpoint, told, motors)

    def _near(self, setpoint: JointSetpoint, told: F64, motors: MotorMap) -> F64:
        """The setpoints, at most `max_relative_target` away from the reading, so that they do not
        run away from an arm that does not follow; the lock is held.

        LeRobot's own bound reads the motors again without a check: one wrong answer would then
        become a goal.
        """
        farthest = self._options.max_relative_target
        if farthest is not None:
            reach = farthest * np.abs([unit.scale for unit in motors.units])
            goal = np.clip(setpoint.position, told - reach, told + reach)
            is_clipped = goal != setpoint.position
            if is_clipped.any():
                self._clipped += 1
                setpoint.position = goal
                # braking begins at the arm's current speed
                setpoint.velocity = np.where(is_clipped, self._velocity, setpoint.velocity)
        return setpoint.position.copy()

    def _note_clipped(self, sent: F64) -> None:
        """LeRobot sent other goals, because of a bound in its own `settings`."""
        with self._lock:
            self._clipped += 1
            if self._setpoint is not None:
                self._setpoint.position = sent.copy()
