"""The driver `fci`: a real FR3, or a simulator that speaks its network protocol."""

from __future__ import annotations

import importlib
import logging
import threading
import time
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rn_robot_fr3.cell import MOVED
from rn_robot_fr3.fci import faults
from rn_robot_fr3.fci.arm import ClientError, FciArm, FciState
from rn_robot_fr3.fci.faults import ArmFault
from rn_robot_fr3.fci.gripper import FciGripper
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.fci.planner import plan
from rn_robot_fr3.fci.scene import SceneFeed
from rn_robot_fr3.fci.state_topics import StateTopics, described
from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT, FINGER_OPEN_M, MIMIC_FINGER_JOINT
from rn_simulation.command import checked
from roboneuron import (
    ConfigurationError,
    JointCommand,
    JointSample,
    RefusedError,
    RoboNeuronError,
    RobotProfile,
    RobotState,
    StateError,
    Topics,
)

log = logging.getLogger(__name__)
F64 = NDArray[np.float64]

_PERIOD_S = 0.008
_IDLE_S = 1.0
"""Time after a motion until the control loop is ended as well, so that no packet can be late while
nothing moves.
"""
_RECOVERY_S = 2.0
_JOIN_S = 5.0


class FciDriver:
    """Follows the protocol `RobotDriver`, with `recover`; every method may be called from any
    thread.
    """

    def __init__(
        self, config: FciDriverOptions | None, profile: RobotProfile, topics: Topics
    ) -> None:
        """Store the arguments. Raises ConfigurationError without a host or for another robot's
        profile.
        """
        if config is None:
            raise ConfigurationError(
                "The driver 'fci' needs an address.", hint="Set host in [plugins.fr3]."
            )
        if profile.arm_joints != ARM_JOINTS:
            raise ConfigurationError(
                f"The driver 'fci' moves {', '.join(ARM_JOINTS)}, the profile {profile.name!r} "
                "has others."
            )
        self._options = config
        self._topics = topics
        self._arm: FciArm | None = None
        self._gripper: FciGripper | None = None
        self._scene = SceneFeed(config.scene, topics) if config.scene else None
        self._told: StateTopics | None = None
        self._commanding = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._fault: ArmFault | None = None
        self._state: RobotState | None = None
        self._measured: FciState | None = None
        self._measured_ns = 0
        self._asked_s = 0.0
        self._busy_until_s = 0.0
        self._stopped_s = 0.0
        self._watchdog_stops = 0

    def open(self) -> None:
        """Connect to arm and gripper; the arm stays where it is.

        Raises:
            StateError: it is already open.
            ConfigurationError, NotReadyError, MissingDependencyError: it failed; tells what to do.
        """
        if self._arm is not None:
            raise StateError("The driver 'fci' is open already.")
        arm = FciArm(self._options)
        gripper = (
            FciGripper(self._options, importlib.import_module("franky"))
            if self._options.gripper
            else None
        )
        try:
            arm.connect()
            self._arm = arm
            if gripper is not None:
                gripper.open()
                self._gripper = gripper
            if self._scene is not None:
                self._scene.open()
        except Exception:
            arm.close()
            self.close()
            raise
        if self._told is None:
            self._told = StateTopics(self._topics)
        self._fault = None
        self._stop.clear()
        self._asked_s = time.monotonic()
        self._take(arm.read())
        if self._fault is None and arm.refusal:
            self._fail(faults.settings_refused(arm.refusal))
        self._thread = threading.Thread(target=self._watch, name="fci-state", daemon=True)
        self._thread.start()

    def read(self) -> RobotState:
        """Return the newest state, measured 125 times per second.

        `detail` holds "mode", "fault" and "fault_hint" (empty without one), "errors",
        "control_success_rate", "joints_rad", "velocity_rad_s", "torque_nm", "external_torque_nm",
        "external_wrench" (N, Nm, base frame), "tcp_m", "watchdog_stops", "missed_cycles",
        "realtime" and "gripper". The same values are published on the topics of `state_topics`.

        Raises:
            StateError: not open.
        """
        self._asked_s = time.monotonic()
        state = self._state
        if self._arm is None or state is None:
            raise StateError("The driver 'fci' is not open.")
        return state

    def send(self, command: JointCommand) -> JointCommand:
        """Move towards `command`; it replaces the previous command, without a jump in position,
        velocity or acceleration.

        Returns:
            The command with positions inside the limits and an estimate of its duration.

        Raises:
            InvalidInputError: an unknown joint, a wrong size, a non-finite value, a duration <= 0;
                nothing is sent.
            StateError: not open.
            UnsafeError: the arm has a fault; tells which, and what to do.
        """
        values = checked(command, MOVED)
        if (braking := self._arm) is not None:
            braking.await_rest()  # without the lock, so that states are measured meanwhile
        with self._commanding:
            arm, measured = self._arm, self._measured
            if arm is None or measured is None:
                raise StateError("The driver 'fci' is not open.")
            if self._fault is not None:
                raise self._fault.error()
            sent = dict(values)
            duration_s = command.duration_s
            if any(name in values for name in ARM_JOINTS):
                target = np.array(
                    [values.get(n, q) for n, q in zip(ARM_JOINTS, measured.position, strict=True)]
                )
                course = plan(
                    measured.position, target, command.duration_s, self._options.dynamics_factor
                )
                try:
                    arm.go(course)
                except Exception as error:
                    self._fail(faults.from_exception(error))
                    raise faults.from_exception(error).error() from error
                duration_s = course.duration_s
                sent.update(
                    (n, float(q))
                    for n, q in zip(ARM_JOINTS, course.target, strict=True)
                    if n in values
                )
                self._busy_until_s = time.monotonic() + duration_s + _IDLE_S
        if self._gripper is not None and FINGER_JOINT in values:
            sent[FINGER_JOINT] = float(np.clip(values[FINGER_JOINT], 0.0, FINGER_OPEN_M))
            self._gripper.aim(2 * sent[FINGER_JOINT])
        return replace(
            command, position=np.array([sent[n] for n in command.names]), duration_s=duration_s
        )

    def hold(self) -> None:
        """Brake the arm to a standstill; the gripper keeps its grasp. Raises StateError unless
        open.
        """
        with self._commanding:
            if self._arm is None:
                raise StateError("The driver 'fci' is not open.")
            self._busy_until_s = time.monotonic() + _IDLE_S
            if self._fault is None:
                try:
                    self._arm.stop()
                except Exception as error:  # it has already stopped by itself
                    self._fail(faults.from_exception(error))

    def recover(self) -> str:
        """Clear the fault, on a person's request. The arm does not move until the next command.

        Returns:
            The code of the cleared fault.

        Raises:
            StateError: there is no fault, or it is not open.
            RefusedError: the cause persists; tells what to do.
        """
        with self._commanding:
            arm, fault = self._arm, self._fault
            if arm is None:
                raise StateError("The driver 'fci' is not open.")
            if fault is None:
                raise StateError("The arm has no fault to recover from.")
            try:
                now = self._recovered(arm, fault)
            except (RoboNeuronError, ClientError) as error:
                raise faults.still(fault, error) from error
            if now is not None:
                self._fail(now)
                raise RefusedError(
                    f"The FR3 cannot be recovered ({now.code}): {now.message}",
                    hint=now.hint,
                    rule="recovery",
                )
            self._fault = None
            self._busy_until_s = 0.0
            self._take(arm.read())
            self._asked_s = time.monotonic()
            log.warning("Recovered from %s.", fault.code)
            return fault.code

    def _recovered(self, arm: FciArm, fault: ArmFault) -> ArmFault | None:
        """Try to clear the fault; return the remaining one. No motion is started or resumed."""
        if fault.code == "communication_lost":
            arm.connect()
        with suppress(ClientError):  # the error that ended the last motion
            arm.read()
        state = arm.read()
        found = faults.from_mode(state.mode, state.errors)
        if found is not None and found.stands:
            return found
        arm.recover()
        deadline_s = time.monotonic() + _RECOVERY_S
        while (
            found := faults.from_mode(state.mode, state.errors)
        ) and time.monotonic() < deadline_s:
            time.sleep(_PERIOD_S)
            state = arm.read()
        if found is None and arm.refusal:
            return faults.settings_refused(arm.refusal)
        return found

    def close(self) -> None:
        """Stop under control and disconnect; may be called twice and before `open`."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None
        with self._commanding:
            arm, self._arm, self._state = self._arm, None, None
        if arm is not None:
            arm.close()
        if self._gripper is not None:
            self._gripper.close()
            self._gripper = None
        if self._scene is not None:
            self._scene.close()

    def _watch(self) -> None:
        """Measure, detect faults, and end motions that nobody supervises."""
        while not self._stop.wait(_PERIOD_S):
            with self._commanding:
                arm = self._arm
                if arm is None:
                    return
                try:
                    self._look_after(arm)
                except Exception as error:  # the error that ended a motion, or the connection
                    self._end(arm, error)

    def _end(self, arm: FciArm, error: Exception) -> None:
        """Handle a motion that ended by itself: a mode that stands tells more than the error."""
        with suppress(ClientError):
            self._note(arm.read())
        seen = self._measured
        found = faults.from_mode(seen.mode, seen.errors) if seen is not None else None
        self._fail(found if found is not None and found.stands else faults.from_exception(error))

    def _look_after(self, arm: FciArm) -> None:
        if self._fault is not None and self._fault.code == "communication_lost":
            self._show()
            return
        self._take(arm.read())
        now_s = time.monotonic()
        if not arm.is_moving:
            return
        is_hung = (
            now_s - self._asked_s > self._options.watchdog_s and now_s > self._stopped_s + _IDLE_S
        )
        if is_hung:
            self._watchdog_stops += 1
            self._stopped_s = now_s
            log.error(
                "The robot module has asked for nothing for %.2f s: the arm stops.",
                now_s - self._asked_s,
            )
        if is_hung or now_s > self._busy_until_s:
            arm.stop()
            self._busy_until_s = now_s + _IDLE_S

    def _note(self, measured: FciState) -> None:
        """Store a state with the ROS time of its arrival; a state that is read again keeps it."""
        if self._measured is None or measured.received_s > self._measured.received_s:
            age_s = time.monotonic() - measured.received_s
            self._measured_ns = self._topics.now_ns() - int(age_s * 1e9)
        self._measured = measured

    def _take(self, measured: FciState) -> None:
        self._note(measured)
        found = faults.from_mode(measured.mode, measured.errors)
        if found is not None and (self._fault is None or found.stands):
            self._fail(found)
        self._show()

    def _fail(self, fault: ArmFault) -> None:
        if self._fault != fault:
            log.error("Fault %s: %s %s", fault.code, fault.message, fault.hint)
        self._fault = fault
        if self._measured is not None:
            self._show()

    def _show(self) -> None:
        measured, fault = self._measured, self._fault
        assert measured is not None
        names, position, velocity = ARM_JOINTS, measured.position, measured.velocity
        is_open = None
        detail = {
            **described(measured, fault),
            "watchdog_stops": str(self._watchdog_stops + measured.silences),
            "missed_cycles": f"{measured.missed_cycles}, at most {measured.longest_gap} in a row",
            "realtime": self._options.realtime
            if self._options.realtime == "required"
            else _scheduled(self._arm),
        }
        if self._told is not None:
            self._told.publish(measured, fault, self._measured_ns)
        if self._gripper is None:
            detail["no_gripper"] = "true"
        else:
            finger_m = self._gripper.width_m / 2
            names = (*ARM_JOINTS, FINGER_JOINT, MIMIC_FINGER_JOINT)
            position, velocity = (
                np.append(position, [finger_m, finger_m]),
                np.append(velocity, [0.0, 0.0]),
            )
            is_open = float(np.clip(finger_m / FINGER_OPEN_M, 0.0, 1.0))
            detail["gripper"] = self._gripper.note
            detail["holding"] = "true" if self._gripper.is_holding else "false"
        if self._scene is not None:
            detail |= self._scene.detail()
        self._state = RobotState(
            joints=JointSample(
                names=names, position=position, velocity=velocity, stamp_ns=self._measured_ns
            ),
            gripper_open=is_open,
            detail=detail,
        )


def _scheduled(arm: FciArm | None) -> str:
    return (
        "ignored; scheduled first in, first out"
        if arm is not None and arm.is_realtime
        else "ignored"
    )
