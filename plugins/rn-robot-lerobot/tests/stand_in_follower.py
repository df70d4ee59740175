"""A stand-in for lerobot's robot with simulated motors; it scales raw numbers as lerobot does (see
data/scaling.json).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import SimpleNamespace

from rn_robot_lerobot.arm import JOINTS
from rn_robot_lerobot.bus.arm import SerialArm
from rn_robot_lerobot.bus.chain import READ, SYNC_WRITE, WRITE, Packet
from rn_robot_lerobot.bus.reference import ASSEMBLED_SO101

TORQUE, GOAL, POSITION = 40, 42, 56


class NormMode(Enum):
    DEGREES = "degrees"
    RANGE_0_100 = "range_0_100"
    RANGE_M100_100 = "range_m100_100"


@dataclass(frozen=True)
class StandInMotor:
    id: int
    norm_mode: NormMode


class StandInFollower:
    """The part of lerobot's robot that the driver uses, with lerobot's scaling."""

    name = "so_follower"

    def __init__(self, arm: SerialArm, path: Path, cap: float | None = None) -> None:
        self._arm, self.calibration_fpath, self.cap = arm, path, cap
        self.bus = SimpleNamespace(
            motors={
                name: StandInMotor(
                    number, NormMode.RANGE_0_100 if name == "gripper" else NormMode.DEGREES
                )
                for number, name in enumerate(JOINTS, 1)
            }
        )
        self.action_features = dict.fromkeys((f"{name}.pos" for name in JOINTS), float)
        self.is_calibrated = True
        self.is_connected = False
        self.calibration = ASSEMBLED_SO101.calibration()
        self.missed = 0
        """Number of further failing attempts to connect."""
        self.wild = 0
        """Number of further implausible readings."""
        self.good = 0
        """Number of plausible readings so far."""

    def connect(self, calibrate: bool = True) -> None:
        assert not calibrate  # it would wait for a person
        assert not self.is_connected
        self.is_connected = True
        if self.missed > 0:
            self.missed -= 1
            raise ConnectionError("There is no status packet!")
        for number in range(1, 7):
            self._ask(Packet(number, WRITE, bytes((TORQUE, 1))))

    def get_observation(self) -> dict[str, float]:
        values = {}
        for name, motor in self.bus.motors.items():
            answer = self._ask(Packet(motor.id, READ, bytes((POSITION, 2))))
            raw = int.from_bytes(answer[5:7], "little")
            low, high = self.calibration[name].range_min, self.calibration[name].range_max
            if name == "gripper":
                values[f"{name}.pos"] = (min(high, max(low, raw)) - low) / (high - low) * 100
            else:
                values[f"{name}.pos"] = (raw - (low + high) / 2) * 360 / 4095
        if self.wild > 0:
            self.wild -= 1
            values["wrist_flex.pos"] -= 80.0
        else:
            self.good += 1
        return values

    def send_action(self, action: dict[str, float]) -> Mapping[str, float]:
        goals = dict(action)
        if self.cap is not None:
            for key, present in self.get_observation().items():
                goals[key] = present + min(max(goals[key] - present, -self.cap), self.cap)
        data = b""
        for name, motor in self.bus.motors.items():
            low, high = self.calibration[name].range_min, self.calibration[name].range_max
            value = goals[f"{name}.pos"]
            is_jaw = name == "gripper"
            raw = value / 100 * (high - low) + low if is_jaw else value * 4095 / 360
            raw += 0.0 if is_jaw else (low + high) / 2
            data += bytes((motor.id, *int(raw).to_bytes(2, "little")))
        self._ask(Packet(254, SYNC_WRITE, bytes((GOAL, 2)) + data), is_answered=False)
        return goals

    def disconnect(self) -> None:
        self.is_connected = False

    def _ask(self, packet: Packet, *, is_answered: bool = True) -> bytes:
        answer = self._arm.motors.answer(packet)
        if is_answered and not answer:
            raise ConnectionError("There is no status packet!")
        return answer
