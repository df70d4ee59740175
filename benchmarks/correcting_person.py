"""A scripted person who corrects a learned policy through the page's websocket, as the teacher
would act on the true scene. Used by record_corrections.py.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed

from rn_controller_urdf.controller import UrdfController
from rn_policy_cubes.demonstrations import COLOURS, ROW, situations
from rn_policy_cubes.teacher import GRASP_M, STEP_S, act, yaw_of
from rn_robot_fr3.cell import CELLS
from rn_robot_fr3.profile import profile
from rn_simulation.ground_truth import LIFTED_M
from rn_simulation.scene_state import TOPIC, SceneState, from_message
from rn_standard.teleoperation.rows import Acting
from rn_testing.waiting import holds_within, wait_until
from roboneuron import JointSample, matrix_from_quaternion

if TYPE_CHECKING:
    from std_msgs.msg import Float64MultiArray

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins" / "rn-view" / "tests"))
from lead_client import LeadPage

sys.path.pop(0)

F64 = NDArray[np.float64]

PERIOD_S = 1.0 / 30.0
LATE_S = 0.09
"""After such a pause of this process the switch has to be released and pressed again."""
LEADS = 4
"""Attempts to lead; a machine that is held up ends a lead."""
LIFT_ENOUGH_M = LIFTED_M + 0.03
PUT_DOWN_S = 40.0
_REST_M_S, _HAND_M_S = 0.15, 0.24
_CLEAR_M, _NEAR_HOME_M = 0.14, 0.06
_FRESH_S = 2.0


class Truth:
    """The simulator's state, from its topic, and who acts; read from any thread."""

    def __init__(self, robot: str, stack: ExitStack) -> None:
        """Subscribe until `stack` is closed. Requires ROS_DOMAIN_ID."""
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import qos_profile_sensor_data
        from std_msgs.msg import Float64MultiArray

        self.who = ""
        self._state: SceneState | None = None
        self._at_s = 0.0
        self._counts = {name: len(cell.joints) for name, cell in CELLS.items()}
        self._joints, self._gripper = CELLS[robot].joints, profile().gripper
        self._controller = UrdfController(None, profile())
        self._controller.load()
        context = rclpy.Context()
        context.init()
        node = rclpy.create_node("correcting_person", context=context)
        for topic, take in ((TOPIC, self._take), ("acting", self._note)):
            node.create_subscription(
                Float64MultiArray, f"/{robot}/{topic}", take, qos_profile_sensor_data
            )
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        thread = threading.Thread(target=executor.spin, daemon=True)
        thread.start()
        stack.callback(context.shutdown)
        stack.callback(thread.join, 5.0)
        stack.callback(executor.shutdown)
        wait_until(lambda: self._state is not None, 30.0, "a state of the simulation")

    def row(self, colour: str) -> NDArray[np.void]:
        """The present state, of the dtype `ROW`, (). Raises RuntimeError if it is old."""
        state = self._state
        if state is None or time.monotonic() - self._at_s > _FRESH_S:
            raise RuntimeError("The simulation's state does not come.")
        row = np.zeros((), dtype=ROW)
        sample = JointSample(names=self._joints, position=state.joints, stamp_ns=state.stamp_ns)
        pose = self._controller.forward(sample)
        row["tcp_m"] = pose.position_m
        row["rotation"] = matrix_from_quaternion(pose.quaternion_xyzw)
        assert self._gripper is not None, "the FR3 has one"
        finger = float(state.joints[self._joints.index(self._gripper.joint)])
        row["opening"] = self._gripper.to_opening(finger)
        row["target"] = COLOURS.index(colour)
        for (name, edge_m), cube in zip(state.cubes, state.cube_poses, strict=True):
            index = COLOURS.index(name)
            row["cube_m"][index], row["edge_m"][index] = cube[:3], edge_m
            row["cube_yaw_rad"][index] = yaw_of(matrix_from_quaternion(cube[3:]))
        return row

    def lifted_m(self) -> dict[str, float]:
        """Height of each cube above its place on the table. Raises as `row`."""
        row = self.row(COLOURS[0])
        heights = row["cube_m"][:, 2] - row["edge_m"] / 2
        return dict(zip(COLOURS, heights.tolist(), strict=True))

    def _take(self, message: Float64MultiArray) -> None:
        self._state = from_message(message, self._counts)
        self._at_s = time.monotonic()

    def _note(self, message: Float64MultiArray) -> None:
        self.who = Acting.from_message(message).who


class CorrectingPerson:
    """Takes over, corrects until the named cube is lifted, hands back, and puts the cube down.

    Attributes:
        leads: number of leads of this episode.
        led_s: time for which the person has led [s].
    """

    def __init__(self, url: str, truth: Truth) -> None:
        self._page = LeadPage(url)
        self._truth = truth
        self._home_m: F64 = truth.row(COLOURS[0])["tcp_m"].astype(np.float64)
        self.leads, self.led_s = 0, 0.0

    def close(self) -> None:
        """Close the page."""
        with suppress(ConnectionClosed):
            self._page.socket.close()

    def correct(self, colour: str, limit_s: float) -> str:
        """Lead the arm until the cube is lifted; it is still led then. Returns "", or why that was
        not reached.
        """

        def teach(row: NDArray[np.void]) -> tuple[F64, float] | None:
            cube = COLOURS.index(colour)
            if row["cube_m"][cube, 2] - row["edge_m"][cube] / 2 > LIFT_ENOUGH_M:
                return None
            action = act(situations(row[None], cube))[0]
            return action[:6] / STEP_S, float(action[6])

        return self._lead(colour, teach, limit_s)

    def hand_back(self) -> str:
        """Hand the arm back; returns the reason of a refusal, or ""."""
        return self._page.ask({"back": 1})

    def put_down(self, colour: str) -> str:
        """Put down what is held, and lead the arm to its first place; returns as `correct`."""
        phase = 0

        def lower(row: NDArray[np.void]) -> tuple[F64, float] | None:
            nonlocal phase
            down_m = float(row["tcp_m"][2]) - (GRASP_M + 0.004)
            if phase == 0 and down_m < 0.003:
                phase = 1
            if phase == 1 and row["opening"] > 0.95:
                phase = 2
            to_home = self._home_m - row["tcp_m"]
            if phase == 2 and np.linalg.norm(to_home) < _NEAR_HOME_M:
                return None
            twist = np.zeros(6)
            if phase == 0:
                twist[2] = -min(_REST_M_S, 2.0 * down_m)
            elif phase == 2:
                to_home[:2] *= row["tcp_m"][2] > _CLEAR_M
                far_m = max(float(np.linalg.norm(to_home)), 1e-9)
                twist[:3] = to_home * min(3.0, _HAND_M_S / far_m)
            return twist, float(phase > 0)

        return self._lead(colour, lower, PUT_DOWN_S)

    def _lead(
        self,
        colour: str,
        wish: Callable[[NDArray[np.void]], tuple[F64, float] | None],
        limit_s: float,
    ) -> str:
        """Send what `wish` makes of the state until it is None; leads again after a lost lead."""
        end_s, why = time.monotonic() + limit_s, ""
        for _ in range(LEADS):
            if time.monotonic() > end_s:
                break
            if not self._page.is_led:
                why = self._page.lead()
                # the end of an earlier lead may be told between the request and its answer
                if not holds_within(lambda: self._page.is_led, 1.0):
                    why = why or self._page.text or "the lead did not begin"
                    continue
                self.leads += 1
            begun_s = time.monotonic()
            try:
                if self._send(colour, wish, end_s):
                    return ""
            except ConnectionClosed:
                return "the page was disconnected"
            finally:
                self.led_s += time.monotonic() - begun_s
            why = self._page.text or why
        return why or f"not within {limit_s:g} s"

    def _send(
        self,
        colour: str,
        wish: Callable[[NDArray[np.void]], tuple[F64, float] | None],
        end_s: float,
    ) -> bool:
        self._page.press()
        sent_s = time.monotonic()
        while self._page.is_led and time.monotonic() < end_s:
            told = wish(self._truth.row(colour))
            if told is None:
                # the arm comes to rest under the person's hand
                self._page.push([0.0] * 6, 0.15, held=False)
                return True
            note = self._page.echoes[-1][3] if self._page.echoes else ""
            if time.monotonic() - sent_s > LATE_S or "press it again" in note:
                self._page.press()
            twist, grip = told
            self._page.send(twist.tolist(), held=True, grip=grip)
            sent_s = time.monotonic()
            time.sleep(PERIOD_S)
        return False


def policy_holds(truth: Truth, colour: str, within_s: float, for_s: float) -> bool:
    """Whether the policy acts again and keeps the cube lifted for a time."""

    def holds() -> bool:
        return truth.who == "policy" and truth.lifted_m()[colour] > LIFTED_M - 0.02

    if not holds_within(holds, within_s, poll_s=0.02):
        return False
    end_s = time.monotonic() + for_s
    while time.monotonic() < end_s:
        if truth.lifted_m()[colour] < LIFTED_M - 0.02:
            return False
        time.sleep(0.02)
    return True
