"""Leaders other than a program: lerobot's own leader arm, and another robot of RoboNeuron."""

from __future__ import annotations

import json
import time
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from anyio.from_thread import start_blocking_portal
from lerobot_lane import JOINTS, PATIENT, Lerobot, Served, Watch

from rn_robot_lerobot.bus.arm import SerialArm
from rn_robot_lerobot.bus.reference import ASSEMBLED_SO101
from rn_robot_lerobot.simulation import CELL
from rn_testing.waiting import wait_until

ACTION_TIMEOUT_S, BRAKING_S = 0.5, 0.3
"""Of control; what the simulated arm needs beyond it on a busy machine."""
END_S = 200.0
_HAND_S = 0.02
pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600)]


def pan_deg(watch: Watch) -> float:
    return float(np.degrees(watch.seen[-1][1][0]))


class HandMovedArm(SerialArm):
    """The motors of a leader arm, whose first joint is turned by hand; without physics.

    Attributes:
        wanted_rad: position to which it is turned [rad], at 0.2 rad/s.
    """

    wanted_rad = 0.0

    def _move(self) -> None:
        position, still = CELL.start.copy(), np.zeros(len(CELL.start))
        while not self._ending.wait(_HAND_S):
            step = 0.2 * _HAND_S
            position[0] += float(np.clip(self.wanted_rad - position[0], -step, step))
            with self._lock:
                self.motors.measure(position, still)
            self.history.append((time.monotonic(), position.copy()))


def test_lerobots_own_leader_arm_leads(
    lerobot: Lerobot, served: Served, watch: Watch, tmp_path: Path
) -> None:
    """Its class, motors behind a serial port, and a hand that moves the arm without torque."""
    calibration = ASSEMBLED_SO101.calibration()
    text = json.dumps({name: asdict(motor) for name, motor in calibration.items()})
    (tmp_path / "hand.json").write_text(text, encoding="utf-8")
    with HandMovedArm() as leader:
        process = lerobot.start(
            "lerobot-teleoperate",
            "--robot.type=roboneuron",
            "--robot.robot=so101",
            *PATIENT,
            "--teleop.type=so101_leader",
            f"--teleop.port={leader.port}",
            "--teleop.id=hand",
            f"--teleop.calibration_dir={tmp_path}",
            "--fps=30",
        )
        wait_until(
            lambda: "Teleop loop time" in lerobot.told(process) or process.poll() is not None,
            END_S,
            "the loop",
        )
        assert process.poll() is None, lerobot.last_line(process)
        leader.wanted_rad = 0.3
        wait_until(lambda: abs(pan_deg(watch) - np.degrees(0.3)) < 2.0, 20.0, "the arm to follow")
        begun_s = time.monotonic()
        leader.motors.faults = type(leader.motors.faults)(silent=True)
        assert watch.rest_after_s(begun_s) < 2 * ACTION_TIMEOUT_S + BRAKING_S
        assert process.wait(END_S) != 0


def test_another_robot_of_roboneuron_leads(
    lerobot: Lerobot, served: Served, watch: Watch, tmp_path: Path
) -> None:
    config = tmp_path / "leader.toml"
    config.write_text(
        '[robot]\nname = "so101"\ndriver = "simulated"\nnamespace = "leading_arm"\n'
        '[control]\ncontroller = "urdf"\n'
        f'[supervisor]\nstate_directory = "{tmp_path / "other"}"\n',
        encoding="utf-8",
    )
    with ExitStack() as stack:
        portal = stack.enter_context(start_blocking_portal())
        leader = Served(portal, config, tmp_path / "leader.log")
        stack.callback(leader.close)
        for module in ("robot", "control"):
            leader.call(f"start_{module}")
        leading = Watch("leading_arm", JOINTS)
        stack.callback(leading.close)
        process = lerobot.teleoperate("--teleop.topic=/leading_arm/joint_states")
        wait_until(
            lambda: "Teleop loop time" in lerobot.told(process) or process.poll() is not None,
            END_S,
            "the loop",
        )
        assert process.poll() is None, lerobot.last_line(process)
        leader.call("move_joints", positions={"shoulder_pan": 0.4, "wrist_roll": -0.3})
        wait_until(
            lambda: (
                np.abs(watch.seen[-1][1] - leading.seen[-1][1]).max() < 0.03
                and abs(watch.seen[-1][1][0] - 0.4) < 0.03
            ),
            20.0,
            "both to be alike",
        )
        leader.call("stop_robot")
        assert process.wait(END_S) != 0
        assert "The leader on /leading_arm/joint_states has been silent" in lerobot.last_line(
            process
        )
