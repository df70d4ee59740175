"""A robot of lerobot installed by a third party: joints with its own names in radians, one of them
inverted, a gripper with 0 for open, and no bus known to lerobot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot.robots import Robot, RobotConfig

NAMES = ("j1", "j2", "j3", "j4", "j5", "claw")


@RobotConfig.register_subclass("thirdarm")
@dataclass
class ThirdArmConfig(RobotConfig):
    speed: float = 1.0
    fails_after: int = -1
    """Number of readings until it fails; -1 for never."""
    forgets: str = ""
    """Instead of failing, it omits this value."""


class ThirdArm(Robot):
    config_class = ThirdArmConfig
    name = "thirdarm"

    def __init__(self, config: ThirdArmConfig) -> None:
        super().__init__(config)
        self._left, self._forgets = config.fails_after, config.forgets
        self._is_connected = False
        self._values = dict.fromkeys((f"{name}.pos" for name in NAMES), 0.0)

    @property
    def observation_features(self) -> dict[str, Any]:
        return dict.fromkeys(self._values, float)

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self._values, float)

    @property
    def is_connected(self) -> bool:
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        self._is_connected = True

    def calibrate(self) -> None:
        raise AssertionError("a driver never calibrates")

    def configure(self) -> None:
        """Do nothing."""

    def get_observation(self) -> dict[str, Any]:
        if self._left != 0:
            self._left -= 1
            return dict(self._values)
        if not self._forgets:
            raise ConnectionError("the arm was unplugged")
        return {name: value for name, value in self._values.items() if name != self._forgets}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self._values.update(action)
        return dict(action)

    def disconnect(self) -> None:
        self._is_connected = False
