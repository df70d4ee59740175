"""The arm through franky: its C++ thread talks to the robot at 1 kHz, Python only tells it where to go."""

from __future__ import annotations

import importlib
import logging
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rn_robot_fr3.fci import faults
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.fci.planner import (
    JERK_LIMIT_RAD_S3,
    MOTION_SHARE,
    STOP_ACCELERATION_RAD_S2,
    VELOCITY_LIMIT_RAD_S,
    Plan,
    braking_distance,
)

log = logging.getLogger(__name__)
F64 = NDArray[np.float64]

PORT = 1337
"""TCP port of the FCI; libfranka has no other."""
_PRIORITY = 20
_PROBE_S = 3.0
_STOP_S = 5.0
_BRAKING_S = 0.5
"""Longer than any stop: 2.6 rad/s at 7.4 rad/s^2 takes 0.36 s."""
_LOOK_S = 0.002
_DELAY_S = 0.001
"""From the state that a stop is planned from to its first command."""
_NO_FILTER_HZ = 1000.0
"""libfranka's kMaxCutoffFrequency: with its low-pass filter on, a change of target is a jump in acceleration."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ArmState:
    """What the control box measured.

    Attributes:
        position, velocity, torque: float64 (7,) [rad, rad/s, Nm].
        external_torque: float64 (7,), filtered [Nm].
        wrench: float64 (6,), external force [N] and torque [Nm] at the stiffness frame, in the base frame.
        tcp_m, tcp_xyzw: float64 (3,) and (4,), position and unit quaternion of the end effector that Desk has
            configured, in the base frame.
        mode: libfranka's RobotMode, such as "Idle".
        errors: flags that are set now.
        success_rate: share of the last 100 commands that came in time; 0 when none are sent.
    """

    position: F64
    velocity: F64
    torque: F64
    external_torque: F64
    wrench: F64
    tcp_m: F64
    tcp_xyzw: F64
    mode: str
    success_rate: float
    errors: tuple[str, ...] = field(default=())


def load_client() -> Any:
    """The client library; imported when it is needed, for it takes 0.1 s."""
    return importlib.import_module("franky")


class FciArm:
    """One connection; methods raise the client library's exceptions unless said otherwise."""

    def __init__(self, options: FciDriverOptions, client: Any) -> None:
        self._options = options
        self._client = client
        self._robot: Any = None
        self._flags = [name for name in dir(client.Errors) if not name.startswith("_")]
        self._is_stopping = False
        self.is_realtime = False

    def connect(self) -> None:
        """Connect anew and set limits, thresholds and load.

        Raises:
            ConfigurationError, NotReadyError: it cannot be; says what to do.
        """
        self._robot = None  # before the next: the control box serves one client
        host = self._options.host
        try:
            socket.create_connection((host, PORT), _PROBE_S).close()
        except OSError as error:
            raise faults.unreachable(host, str(error.strerror or error)) from error
        self._robot = self._open_in_time(host)
        self._robot.joint_velocity_limit.set(VELOCITY_LIMIT_RAD_S)
        self._robot.joint_acceleration_limit.set(STOP_ACCELERATION_RAD_S2)
        self._robot.joint_jerk_limit.set(JERK_LIMIT_RAD_S3)
        self._robot.set_collision_behavior(self._options.collision_torque_nm, self._options.collision_force_n)
        if self._options.load_kg > 0.0:
            self._robot.set_load(self._options.load_kg, list(self._options.load_centre_m), [0.0] * 9)

    def _open_in_time(self, host: str) -> Any:
        """Connect in a thread that may be left behind: the library waits a minute for an answer."""
        config = self._client.RealtimeConfig
        realtime = config.Enforce if self._options.realtime == "required" else config.Ignore
        outcome: list[Any] = []
        expired = threading.Event()

        def connect() -> None:
            try:
                robot = self._client.Robot(host, realtime_config=realtime)
            except Exception as error:  # carried to the caller's thread
                outcome.append(error)
                return
            if not expired.is_set():
                outcome.append(robot)

        thread = threading.Thread(target=connect, name="fci-connect", daemon=True)
        thread.start()
        thread.join(self._options.connect_timeout_s)
        if not outcome:
            expired.set()
            raise faults.silent(host, self._options.connect_timeout_s)
        if isinstance(outcome[0], Exception):
            raise faults.while_connecting(outcome[0], host) from outcome[0]
        return outcome[0]

    def read(self) -> ArmState:
        """The newest state; takes 2 ms when no motion runs. Raises too what ended a motion."""
        self._robot.poll_motion()
        state = self._robot.state
        return ArmState(
            position=np.array(state.q, dtype=np.float64),
            velocity=np.array(state.dq, dtype=np.float64),
            torque=np.array(state.tau_J, dtype=np.float64),
            external_torque=np.array(state.tau_ext_hat_filtered, dtype=np.float64),
            wrench=np.array(state.O_F_ext_hat_K, dtype=np.float64),
            tcp_m=np.array(state.O_T_EE.translation, dtype=np.float64).ravel(),
            tcp_xyzw=np.array(state.O_T_EE.quaternion, dtype=np.float64).ravel(),
            mode=state.robot_mode.name,
            success_rate=float(state.control_command_success_rate),
            errors=tuple(name for name in self._flags if getattr(state.current_errors, name) is True),
        )

    @property
    def is_moving(self) -> bool:
        """Whether the control loop runs."""
        return bool(self._robot.is_in_control)

    def go(self, plan: Plan) -> None:
        """Go to the plan's target; replaces the motion before, without a jump. See `await_rest`."""
        client, factor = self._client, self._options.dynamics_factor
        dynamics = client.RelativeDynamicsFactor(plan.velocity_factor, factor * MOTION_SHARE, factor)
        waypoint = client.JointWaypoint(client.JointState(plan.target), relative_dynamics_factor=dynamics)
        self._is_stopping = False
        self._move(client.JointWaypointMotion([waypoint], return_when_finished=False))

    def stop(self) -> None:
        """Brake with the limits' acceleration and jerk, then end the control loop; returns at once.

        What stops already is left alone, and see `await_rest`: what replaces a stop may exceed the arm's limit of jerk.
        """
        if self.is_moving and not self._is_stopping:
            self._move(self._braking())
            self._is_stopping = True

    def _braking(self) -> Any:
        """A motion to the place where the arm comes to rest soonest.

        The client library's own `JointStopMotion` (franky 2.0.0) is a motion to the place where the stop began: the arm
        brakes and then drives back, at 1 rad/s by 0.06 rad with up to 0.8 rad/s. The way is given relative to the
        command at the moment of the hand-over, so that what passes until then does not count.
        """
        client, state = self._client, self._robot.state
        velocity, acceleration = (np.array(values, dtype=np.float64) for values in (state.dq_d, state.ddq_d))
        way = braking_distance(velocity, acceleration) + velocity * _DELAY_S
        return client.JointMotion(client.JointState(way), client.ReferenceType.Relative)

    def await_rest(self) -> None:
        """Return when a stop that has begun is over; at once when there is none."""
        deadline_s = time.monotonic() + _BRAKING_S
        while self._is_stopping and self.is_moving and time.monotonic() < deadline_s:
            time.sleep(_LOOK_S)

    def _move(self, motion: Any) -> None:
        # The thread of the control loop inherits the priority when it is started. While it runs, it goes first.
        with self._realtime_threads(_PRIORITY - 1 if self.is_moving else _PRIORITY):
            self._robot.move(motion, asynchronous=True, cutoff_frequency=_NO_FILTER_HZ)

    @contextmanager
    def _realtime_threads(self, priority: int) -> Iterator[None]:
        """Threads started within the block are scheduled before ordinary ones, where the system allows it."""
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except OSError:
            yield
            return
        self.is_realtime = True
        try:
            yield
        finally:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))

    def recover(self) -> None:
        """Clear the errors of a reflex."""
        self._robot.recover_from_errors()

    def close(self) -> None:
        """Stop and disconnect; may be called twice."""
        robot = self._robot
        if robot is None:
            return
        with suppress(Exception):  # whatever it answers, it is left
            self.stop()
            robot.join_motion(_STOP_S)
        self._robot = None
