"""A simulated arm behind a serial port: physics and motors in threads of this process."""

from __future__ import annotations

import os
import pty
import select
import threading
import time
import tty
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rn_robot_lerobot.arm import GRIPPER_JOINT, JOINTS
from rn_robot_lerobot.bus import dynamixel_packets, packets
from rn_robot_lerobot.bus.chain import MotorChain, Packet
from rn_robot_lerobot.bus.dynamixel_motors import DynamixelChain
from rn_robot_lerobot.bus.motors import FeetechChain
from rn_robot_lerobot.bus.reference import (
    ASSEMBLED_KOCH,
    ASSEMBLED_LEKIWI,
    ASSEMBLED_SO101,
    Assembled,
)
from rn_robot_lerobot.calibration import MotorCalibration
from rn_robot_lerobot.omni_base import WHEELS, base_velocity
from rn_robot_lerobot.simulation import CELL, build_world
from rn_simulation.arm_cell import STEP_S
from rn_simulation.pace import Pace
from rn_simulation.planar_motion import BaseVelocity, PlanarPose, integrate
from rn_simulation.setpoint import JointSetpoint

F64 = NDArray[np.float64]

_MOTOR_SPEED_RAD_S, _MOTOR_ACCELERATION_RAD_S2 = 4.7, 60.0
"""No-load limits of a motor, reached when its goal jumps."""
_POLL_S = 0.02
_JAW = JOINTS.index(GRIPPER_JOINT)


class Plant(Protocol):
    """The mechanics moved by the motors."""

    def step(self, position: F64, velocity: F64) -> None:
        """Advance by `STEP_S` with these motor setpoints, float64 (n,) [rad, rad/s]."""

    def joint_states(self) -> tuple[F64, F64]:
        """Current positions and velocities."""


class Reader(Protocol):
    """Finds packets in a stream of bytes."""

    def feed(self, data: bytes) -> Sequence[Packet]:
        """Packets completed by these bytes."""


class Massless:
    """Joints without dynamics, always at their setpoints."""

    def __init__(self, start: F64) -> None:
        self._states = start.copy(), np.zeros_like(start)

    def step(self, position: F64, velocity: F64) -> None:
        """See `Plant`."""
        self._states = position.copy(), velocity.copy()

    def joint_states(self) -> tuple[F64, F64]:
        """See `Plant`."""
        return self._states


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class SerialKind:
    """One kind of arm.

    Attributes:
        assembled: encoder zeros and calibration of the arm.
        plant: creates the mechanics, from the start positions of the joints, float64 (n,) [rad].
        chain: creates the motors, from the encoder step at each joint's position 0.
        reader: creates the reader of their packets.
    """

    assembled: Assembled
    plant: Callable[[F64], Plant]
    chain: Callable[[Mapping[str, int]], MotorChain]
    reader: Callable[[], Reader]


def _so101_world(start: F64) -> Plant:
    world = build_world([])
    world.prepare_physics(STEP_S, CELL.force.tolist())
    world.set_joints(start.tolist())
    return world


SERIAL_SO101 = SerialKind(
    assembled=ASSEMBLED_SO101,
    plant=_so101_world,
    chain=FeetechChain,
    reader=packets.FeetechPacketReader,
)
"""SO-101 with MuJoCo physics."""
SERIAL_KOCH = SerialKind(
    assembled=ASSEMBLED_KOCH,
    plant=Massless,
    chain=DynamixelChain,
    reader=dynamixel_packets.DynamixelPacketReader,
)


class RollingArm:
    """An SO-101 on a base with wheels that do not slip.

    Attributes:
        pose: pose of the base relative to its start.
    """

    def __init__(self, start: F64) -> None:
        self._count = len(CELL.joints)
        self._arm = _so101_world(start[: self._count])
        self._wheels = start[self._count :].copy(), np.zeros(len(WHEELS))
        self.pose = PlanarPose()

    def step(self, position: F64, velocity: F64) -> None:
        """See `Plant`."""
        self._arm.step(position[: self._count], velocity[: self._count])
        self._wheels = position[self._count :].copy(), velocity[self._count :].copy()
        forwards, leftwards, turning = base_velocity(self._wheels[1]).tolist()
        moving = BaseVelocity(linear_x=forwards, linear_y=leftwards, angular_z=turning)
        self.pose = integrate(self.pose, moving, STEP_S)

    def joint_states(self) -> tuple[F64, F64]:
        """See `Plant`."""
        position, velocity = self._arm.joint_states()
        angles, speeds = self._wheels
        return np.append(position, angles), np.append(velocity, speeds)


SERIAL_LEKIWI = SerialKind(
    assembled=ASSEMBLED_LEKIWI,
    plant=RollingArm,
    chain=FeetechChain,
    reader=packets.FeetechPacketReader,
)


def _advance(setpoint: JointSetpoint, speeds: Mapping[int, float]) -> None:
    """One step of the motors; wheels follow speeds [rad/s], by index."""
    begun, before = setpoint.position.copy(), setpoint.velocity.copy()
    setpoint.advance(STEP_S)
    most = _MOTOR_ACCELERATION_RAD_S2 * STEP_S
    for i, speed in speeds.items():
        setpoint.velocity[i] = before[i] + min(max(speed - before[i], -most), most)
        setpoint.position[i] = begun[i] + setpoint.velocity[i] * STEP_S


class SerialArm:
    """An arm whose port is a pseudo terminal; use it as a context manager.

    Attributes:
        motors: motors on its bus, including faults.
        plant: the mechanics; created on entry.
        port: path of the device.
        history: (monotonic time [s], joints float64 (n,) [rad]) of every step.
    """

    def __init__(
        self,
        kind: SerialKind = SERIAL_SO101,
        calibration: Mapping[str, MotorCalibration] | None = None,
    ) -> None:
        """Args:
        kind: kind of the arm.
        calibration: calibration written into the motors instead of their own; empty for factory-new
            motors.
        """
        self._kind = kind
        self._start = kind.assembled.start_rad()
        self.motors = kind.chain(kind.assembled.encoder_zeros)
        if calibration is None:
            calibration = kind.assembled.calibration()
        if calibration:
            self.motors.calibrate(calibration)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.history: list[tuple[float, F64]] = []
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._threads = [
            threading.Thread(target=self._move, name="serial-arm-physics", daemon=True),
            threading.Thread(target=self._listen, name="serial-arm-bus", daemon=True),
        ]

    def __enter__(self) -> SerialArm:
        self.plant = self._kind.plant(self._start)
        self.motors.measure(*self.plant.joint_states())
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        for thread in self._threads:
            thread.join()
        os.close(self._master)
        os.close(self._slave)

    @property
    def position(self) -> F64:
        """Current joint positions, float64 (n,) [rad]."""
        return self.history[-1][1] if self.history else self._start

    def rest_after_s(self, fault_s: float, tolerance_rad: float = 5e-3) -> float:
        """Time from `fault_s` [monotonic s] until all joints stayed at their current positions
        [s].
        """
        rows = [(at_s, np.delete(row, _JAW)) for at_s, row in self.history if at_s >= fault_s]
        away = [at_s for at_s, row in rows if np.abs(row - rows[-1][1]).max() > tolerance_rad]
        return away[-1] - fault_s if away else 0.0

    def _move(self) -> None:
        count = len(self._start)
        fastest = np.full(count, _MOTOR_SPEED_RAD_S)
        setpoint = JointSetpoint(self._start, fastest, np.full(count, _MOTOR_ACCELERATION_RAD_S2))
        pace = Pace(step_s=STEP_S)
        while not self._ending.is_set():
            steps = pace.due_steps(time.monotonic())
            for _ in range(steps):
                with self._lock:
                    goals, torque = self.motors.goals()
                    speeds = self.motors.speeds()
                # without torque a joint stays, because the simulation carries its weight
                limp = [i for i in range(count) if not torque[i]]
                setpoint.target[limp] = setpoint.position[limp]
                powered = [i for i in range(count) if torque[i]]
                setpoint.aim(goals, powered, STEP_S)
                _advance(setpoint, speeds)
                self.plant.step(setpoint.position, setpoint.velocity)
                position, velocity = self.plant.joint_states()
                with self._lock:
                    self.motors.measure(position, velocity)
            if steps:
                self.history.append((time.monotonic(), position.copy()))
            self._ending.wait(pace.until_next_s(time.monotonic()))

    def _listen(self) -> None:
        reader = self._kind.reader()
        while not self._ending.is_set():
            if not select.select([self._master], [], [], _POLL_S)[0]:
                continue
            for packet in reader.feed(os.read(self._master, 4096)):
                with self._lock:
                    answer = self.motors.answer(packet)
                if answer:
                    time.sleep(self.motors.faults.answer_delay_s)
                    os.write(self._master, answer)
