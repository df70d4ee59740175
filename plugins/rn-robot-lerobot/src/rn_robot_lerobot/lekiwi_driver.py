"""The driver `lerobot` of a LeKiwi: its arm like every arm of LeRobot, and its base."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Protocol, cast

import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry

from rn_robot_lerobot.bus.motors import wheel_stop
from rn_robot_lerobot.lerobot_arm import LerobotRobot
from rn_robot_lerobot.lerobot_driver import LerobotDriver
from rn_robot_lerobot.lerobot_options import LekiwiOptions
from rn_robot_lerobot.omni_base import WHEELS, BaseSetpoint
from rn_robot_lerobot.wheel_guard import WheelGuard
from rn_simulation.planar_motion import BaseVelocity, PlanarPose, integrate, to_message
from roboneuron import InvalidInputError, RefusedError, RobotProfile, RobotState, Topics
from roboneuron.direct_path.twists import check_twist

_KEYS = ("x.vel", "y.vel", "theta.vel")
"""LeRobot's names of a base velocity [m/s, m/s, degrees/s]."""
_LONGEST_STEP_S = 0.1
"""Maximum step of dead reckoning: after a longer silence the motion is unknown."""


class _Motor(Protocol):
    id: int


class _Bus(Protocol):
    port: str
    motors: Mapping[str, _Motor]


class _LekiwiRobot(LerobotRobot, Protocol):
    bus: _Bus

    def stop_base(self) -> None:
        """Stop the wheels."""


class LekiwiDriver(LerobotDriver):
    """It receives velocities on `cmd_vel` and publishes odometry on `odom`.

    The wheels' motors keep their last speed until they receive another one. This driver stops them
    when commands stop coming, on hold, on a fault, and at its start and end; its guard stops them
    when this process is killed or frozen. While the motors receive nothing, nothing can stop them.
    A twist that the base cannot execute is refused as a whole, and the base brakes.
    """

    def __init__(self, config: LekiwiOptions | None, profile: RobotProfile, topics: Topics) -> None:
        """Store the arguments."""
        options = config or LekiwiOptions()
        super().__init__(options, profile, topics)
        named = {endpoint.name: endpoint for endpoint in profile.endpoints}
        self._velocity_in, self._odometry_out = named["velocity"], named["odometry"]
        self._publish: Callable[[Odometry], None] | None = None
        self._is_rolling = False
        self._guard: WheelGuard | None = None
        # also guarded by the lock
        self._base = BaseSetpoint(options.base_timeout_s)
        self._pose, self._observed_s = PlanarPose(), 0.0
        self._refusal, self._refusals = "", 0

    def open(self) -> None:
        """Connect; odometry restarts at zero. Raises as `LerobotDriver.open`."""
        self._base.drop()
        self._pose, self._observed_s = PlanarPose(), time.monotonic()
        self._refusal, self._refusals = "", 0
        if self._publish is None:
            self._publish = self._topics.advertise(self._odometry_out.topic, Odometry)
            self._topics.subscribe(self._velocity_in.topic, Twist, self._on_twist)
        super().open()

    def read(self) -> RobotState:
        """Like `LerobotDriver.read`; `detail` also contains "odometry" (JSON: x_m, y_m, yaw_rad),
        "motion" of the base (driving, standing, or stopping with the reason), and "refused" and
        "refused_count" of velocity commands.
        """
        state = super().read()
        with self._lock:
            base = {
                "odometry": self._pose.described(),
                "motion": self._base.motion,
                "refused": self._refusal,
                "refused_count": str(self._refusals),
            }
        return replace(state, detail={**state.detail, **base})

    def _on_twist(self, message: Twist) -> None:
        """Called by the host's executor; it must not raise."""
        if not self.is_open:
            return
        with self._lock:
            try:
                fields = check_twist(self._velocity_in, message)
                if fault := self._told_fault():
                    raise RefusedError(f"The base is held by a fault: {fault}.", rule="fault")
            except RefusedError as error:
                self._base.halt("a command was refused")
                self._refusal, self._refusals = str(error), self._refusals + 1
                return
            self._refusal = ""
            wanted = np.array([fields[path] for path in ("linear.x", "linear.y", "angular.z")])
            self._base.aim(wanted, time.monotonic())
            if wanted.any():
                # LeRobot sends both together, so the arm gets its measured position
                self._begin()

    def _connected(self, robot: LerobotRobot) -> None:
        lekiwi = cast("_LekiwiRobot", robot)
        # the wheels may still turn if an earlier driver was killed together with its guard
        lekiwi.stop_base()
        wheels = [lekiwi.bus.motors[name].id for name in WHEELS]
        self._guard = WheelGuard(lekiwi.bus.port, wheel_stop(wheels))
        self._guard.start()

    def _disconnect(self, robot: LerobotRobot) -> None:
        guard, self._guard = self._guard, None
        wheels_stand, is_connected = False, robot.is_connected
        try:
            super()._disconnect(robot)
            wheels_stand = is_connected
        finally:
            if guard is not None:
                guard.close(wheels_stand=wheels_stand)

    def _halt(self) -> None:
        super()._halt()
        self._base.halt("held")

    def _note_silence(self, robot: LerobotRobot, error: Exception) -> None:
        super()._note_silence(robot, error)
        self._tell_guard()
        with self._lock:
            is_fault = bool(self._told_fault())
        if is_fault and self._is_rolling:
            # a motor that does not answer may still receive: if one motor is off the bus, LeRobot
            # reads none
            with suppress(OSError, RuntimeError):
                cast("_LekiwiRobot", robot).stop_base()

    def _observe(self, observed: Mapping[str, float]) -> None:
        absent = [key for key in _KEYS if key not in observed]
        if absent:
            raise InvalidInputError(f"The robot does not report {', '.join(absent)}.")
        forwards, leftwards, turning = (float(observed[key]) for key in _KEYS)
        if self._guard is not None and (fault := self._guard.fault()):
            with self._lock:
                self._note_fault(fault)
        velocity = BaseVelocity(
            linear_x=forwards, linear_y=leftwards, angular_z=math.radians(turning)
        )
        now_s = time.monotonic()
        with self._lock:
            since_s, self._observed_s = now_s - self._observed_s, now_s
            pose = self._pose = integrate(self._pose, velocity, min(since_s, _LONGEST_STEP_S))
        if self._publish is not None:
            stamp_ns, link = self._topics.now_ns(), self._profile.base_link
            self._publish(to_message(pose, velocity, stamp_ns=stamp_ns, base_link=link))

    def _send_goals(
        self, robot: LerobotRobot, goals: Mapping[str, float], period_s: float
    ) -> Mapping[str, float]:
        with self._lock:
            if goals:
                self._base.advance(period_s, time.monotonic())
            else:
                self._base.drop()
            forwards, leftwards, turning = self._base.velocity.tolist()
        sent: Mapping[str, float] = {}
        is_rolling = any((forwards, leftwards, turning))
        if goals:
            # the guard is told before the wheels roll, and until they have received their stop
            self._is_rolling = self._is_rolling or is_rolling
            self._tell_guard()
            values = (forwards, leftwards, math.degrees(turning))
            sent = robot.send_action({**goals, **dict(zip(_KEYS, values, strict=True))})
        elif self._is_rolling:
            cast("_LekiwiRobot", robot).stop_base()
        self._is_rolling = is_rolling
        self._tell_guard()
        return sent

    def _tell_guard(self) -> None:
        if self._guard is not None:
            self._guard.note(is_rolling=self._is_rolling)
