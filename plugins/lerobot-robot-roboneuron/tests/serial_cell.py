"""A server whose robot module drives, in lerobot's environment, a simulated arm behind a serial
port.
"""

from __future__ import annotations

import json
import threading
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

from anyio.from_thread import start_blocking_portal
from lerobot_lane import BIN, Served

from rn_robot_lerobot.bus.arm import SERIAL_SO101, SerialArm, SerialKind
from rn_robot_lerobot.calibration import MotorCalibration
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError

CONFIG = """
[robot]
name = "{name}"
driver = "lerobot"
python = "{python}"

[control]
controller = "urdf"

[plugins.urdf]
rotation_tolerance_rad = 0.03

[plugins.{name}]
port = "{port}"
calibration_dir = "{folder}"
"""


class SerialCell:
    """A serial arm and a server whose robot module drives it."""

    def __init__(self, folder: Path, stack: ExitStack, kind: SerialKind = SERIAL_SO101) -> None:
        self.folder, self.name = folder, kind.assembled.arm.name
        self.arm = stack.enter_context(SerialArm(kind))
        config = folder / "serial.toml"
        config.write_text(
            CONFIG.format(name=self.name, python=BIN / "python", port=self.arm.port, folder=folder),
            encoding="utf-8",
        )
        portal = stack.enter_context(start_blocking_portal())
        self.server = Served(portal, config, folder / "server.log")
        stack.callback(self.server.close)

    def write_calibration(self, calibration: dict[str, MotorCalibration]) -> None:
        text = json.dumps({name: asdict(motor) for name, motor in calibration.items()})
        (self.folder / f"{self.name}.json").write_text(text, encoding="utf-8")

    def start(self) -> None:
        self.server.call("start_robot")
        self.server.call("start_control")

    def robot(self) -> dict[str, object]:
        modules = self.server.call("get_status")["modules"]
        return next(dict(module) for module in modules if module["module"] == "robot")

    def fault(self) -> str:
        detail = self.robot().get("detail") or {}
        assert isinstance(detail, dict)
        return str(detail.get("fault", ""))

    def move(self, seconds: float = 4.0, **positions: float) -> None:
        self.server.call("move_joints", positions=positions, duration_s=seconds)

    def move_in_background(self) -> None:
        """Start a long motion; the call ends with the expected fault."""
        ended: list[NotReadyError] = []

        def call() -> None:
            try:
                self.move(6.0, shoulder_pan=1.2)
            except NotReadyError as error:
                ended.append(error)

        threading.Thread(target=call, daemon=True).start()
        wait_until(lambda: self.arm.position[0] > 0.15 or ended, 60.0, "the arm to turn")
        assert not ended, ended[0]
