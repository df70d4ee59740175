"""A simulated FR3 whose calls are cancelled, judged by its measured joints."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import ExitStack
from itertools import cycle
from pathlib import Path
from typing import Any

from cancel_wire import LAST_WAYS, TOKENS, HttpClient, StdioClient, Way, served

from rn_testing.domain import free_ros_domain
from rn_testing.waiting import holds_within, wait_until
from roboneuron.config import default_text

WINDOW_S, STILL_RAD, MOVES_RAD = 0.3, 0.003, 0.01
RESTS_RAD, PUSH_M_S, LEAST_STEP_S = 5e-4, 0.05, 0.02
LEAST_SAMPLES = 5
CUBE = "red cube"
INSTRUCTION = f"pick up the {CUBE}"
NEVER = {"kind": "tcp_in", "lower_m": [9, 9, 9], "upper_m": [10, 10, 10]}
HELD = {"kind": "held", "for_s": 0.3, "of": {"kind": "gripper_holds"}}
CONFIG = """
[postures.left]
joints = {{fr3_joint1 = 0.7}}
[postures.right]
joints = {{fr3_joint1 = -0.7}}
[places.near]
position_m = [0.40, 0.0, 0.45]
[places.far]
position_m = [0.55, 0.0, 0.45]
[supervisor]
state_directory = "{folder}/state"
"""
ARM = ("robot", "perception", "control")
TASK = {"instruction": INSTRUCTION, "until": HELD, "on_end": "stop", "max_s": 60}


def point(position: float) -> dict[str, Any]:
    """A message with one trajectory point."""
    points = [{"positions": [position], "time_from_start": 6.0}]
    return {"message": {"joint_names": ["fr3_joint1"], "points": points}}


MOTIONS: dict[str, cycle[tuple[str, dict[str, Any]]]] = {
    "move_joints": cycle(
        ("move_joints", {"positions": {"fr3_joint1": one}, "duration_s": 6}) for one in (0.6, -0.6)
    ),
    "trajectory": cycle(("publish_joint_trajectory", point(one)) for one in (0.6, -0.6)),
    "sequence": cycle(
        ("publish_joint_trajectory_sequence", {"steps": [point(one)]}) for one in (0.6, -0.6)
    ),
    "move_ee": cycle(("move_ee", {"dz_m": one, "duration_s": 5}) for one in (-0.1, 0.1)),
    "posture": cycle(("move_to", {"name": one}) for one in ("left", "right")),
    "straight": cycle([("move_to", {"name": "far"})]),
    "pick": cycle([("pick", {"object": CUBE, "speed": 0.5})]),
    "push": cycle([("push", {"object": CUBE, "dy_m": 0.05})]),
    "place": cycle([("place", {"dx_m": 0.0, "dy_m": -0.12})]),
    "run_task": cycle([("run_task", {"instruction": INSTRUCTION, "until": NEVER, "max_s": 60})]),
}
"""Calls that move the arm until they end; two targets each where one would be reached."""
STARTS: Mapping[str, Mapping[str, Any]] = {
    **{f"start_{kind}": {} for kind in ARM},
    "start_inference": {"instruction": INSTRUCTION},
    "start_all": {"instruction": INSTRUCTION},
}
"""Calls that start modules; two of them a policy that moves the arm."""
SWITCHES = ("switch_perception", "switch_inference", "switch_control")
SIMULATED: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "sim. joints": ("move_joints", {"positions": {"fr3_joint1": 0.2}, "duration_s": 6}),
    "sim. sequence": ("publish_joint_trajectory_sequence", {"steps": [point(0.2)]}),
    "sim. task": ("run_task", {"instruction": INSTRUCTION, "until": NEVER, "max_s": 20}),
}
"""Calls that are simulated."""
OTHERS = ("set_instruction", "lead_arm", *SIMULATED, "start_recording", "play_recording")
CALLS = (*MOTIONS, *STARTS, *SWITCHES, *OTHERS)
FROM_HOME = ("move_ee", "posture", "straight", "pick", "push")


class Arm:
    """Measured joints of the arm, and the server that moves it.

    Attributes:
        steward: a client that observes and prepares.
        files: of a recording, for `play_recording`.
    """

    def __init__(
        self, folder: Path, text: str = "", namespace: str = "fr3", label: str = ""
    ) -> None:
        """Args:
        folder: for files of this arm.
        text: configuration of robot, cameras, policy and control; the default one if empty.
        namespace: of the robot in it.
        label: what it is called in figures.
        """
        self.label = label
        import rclpy
        from geometry_msgs.msg import TwistStamped
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import JointState

        domain = free_ros_domain()
        self.folder, self._text = folder, text or default_text()
        self.environment = {
            "ROS_DOMAIN_ID": str(domain),
            "XDG_STATE_HOME": str(folder),
            "ROBONEURON_RECORDER": "on",
        }
        self._published = 0
        self._names: list[str] = []
        self._pushes, self._releases = threading.Event(), threading.Event()
        self._seen: deque[tuple[float, list[float], float]] = deque(maxlen=200)
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node("judge", namespace=namespace, context=self._context)
        self._node.create_subscription(JointState, "joint_states", self._take, 50)
        self._twists = self._node.create_publisher(TwistStamped, "/lead/twist", 1)
        self._twist = TwistStamped()
        self._node.create_timer(0.02, self._push)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()
        self._stack = ExitStack()
        self._serves = ""
        self._may_hold = False
        self.files: list[str] = []
        self.steward: Any = None
        self.client: Any = None

    def _take(self, message: Any) -> None:
        stamp, self._names = message.header.stamp, list(message.name)
        measured_s = stamp.sec + stamp.nanosec * 1e-9
        self._seen.append((time.monotonic(), list(message.position), measured_s))

    def _push(self) -> None:
        if self._pushes.is_set() or self._releases.is_set():
            self._twist.twist.linear.z = PUSH_M_S if self._pushes.is_set() else 0.0
            self._twist.header.stamp = self._node.get_clock().now().to_msg()
            self._twists.publish(self._twist)
            self._published += 1

    def push(self, is_pushed: bool) -> None:
        """A person pushes a device upwards, or lets go of it."""
        self._releases.clear()
        if is_pushed:
            self._pushes.set()
        else:
            self._pushes.clear()

    def release(self) -> None:
        """A person holds a device, and presses nothing yet; returns when that was received."""
        self._releases.set()
        wait_until(self._twists.get_subscription_count, 10.0, "the lead listens to the device")
        published = self._published
        wait_until(lambda: self._published > published + 20, 10.0, "the device is heard")

    def push_until_it_moves(self) -> None:
        """A person pushes the device, and lets go and pushes again if nothing moves: after a stall
        of the machine for 0.1 s the lead asks for a release before the arm follows.
        """
        for _ in range(16):
            self.release()
            self.push(True)
            if holds_within(self.moves, 2.0):
                return

    def _judged(self, positions: list[float], *, fingers: bool) -> list[float]:
        """The positions of all joints, or of those that are no fingers."""
        named = zip(self._names, positions, strict=True)
        return [one for name, one in named if fingers or "finger" not in name]

    def _travel(self, *, fingers: bool = True) -> float | None:
        """Largest change of a joint within a window that ends now, or with the last measurement of
        a robot that has ended [rad or m]; None without measurements that fill it.
        """
        seen = tuple(self._seen)
        if not seen:
            return None
        end_s = time.monotonic() if self._serves else seen[-1][0]
        inside = [one for one in seen if one[0] >= end_s - WINDOW_S]
        if len(inside) < LEAST_SAMPLES or inside[-1][0] - inside[0][0] < WINDOW_S / 2:
            return None
        joints = zip(
            *(self._judged(positions, fingers=fingers) for _, positions, _ in inside), strict=True
        )
        return max(float(max(one) - min(one)) for one in joints)

    def rests(self) -> bool:
        """The arm is measured at rest."""
        travel = self._travel()
        return travel is not None and travel < STILL_RAD

    def moves(self, *, fingers: bool = True) -> bool:
        """The arm is measured in motion, or its fingers are."""
        return (self._travel(fingers=fingers) or 0.0) > MOVES_RAD

    def fastest_rad_s(self) -> float:
        """Highest speed of a joint of the arm between successive measurements that are kept, by
        their stamps: at least 20 ms apart [rad/s].

        A process that had to wait receives what was measured meanwhile at once.
        """
        seen, fastest = tuple(self._seen), 0.0
        _, before, before_s = seen[0]
        for _, positions, at_s in seen[1:]:
            if at_s - before_s < LEAST_STEP_S:
                continue
            moved = max(abs(a - b) for a, b in zip(positions[:7], before[:7], strict=True))
            fastest = max(fastest, moved / (at_s - before_s))
            before, before_s = positions, at_s
        return fastest

    def rested_after_s(self, since_s: float, *, fingers: bool = True) -> float:
        """How long a joint still moved after a time [monotonic s]; the arm rests now [s]."""
        seen = [
            (at_s, self._judged(positions, fingers=fingers))
            for at_s, positions, _ in tuple(self._seen)
        ]
        rest = seen[-1][1]
        moved = [
            at_s - since_s
            for at_s, positions in seen
            if max(abs(one - there) for one, there in zip(positions, rest, strict=True)) > RESTS_RAD
        ]
        return max([0.0, *moved])

    def use(
        self, transport: str, version: str, way: Way, call: str = ""
    ) -> HttpClient | StdioClient:
        """A client of the running server, or of a new one, whose arm is started."""
        plays = call == "play_recording"
        wanted = f"{transport} {'' if transport == 'http' else version} {'plays' * plays}"
        if plays and not self.files:
            self.record()
        if self._serves != wanted:
            self.end_server()
            configuration = self.folder / "arm.toml"
            configuration.write_text(self._text + CONFIG.format(folder=self.folder) + TOKENS)
            environment = self.environment | ({"ROBONEURON_RECORDER": "play"} if plays else {})
            server = served(configuration, environment, transport=transport)
            process, self._url = self._stack.enter_context(server)
            if transport == "http":
                self.steward = HttpClient(self._url, "2025-11-25")
            else:
                self.steward = self.client = StdioClient(process, version)
            self._serves = wanted
        self._start()
        client = self.client if transport == "stdio" else HttpClient(self._url, version)
        if transport == "http":
            self._stack.callback(client.leave_call)
        if way in LAST_WAYS and transport == "stdio":
            self._serves = ""  # the server ends with its client
        return client

    def _start(self) -> None:
        for kind in ARM:
            if self.phase(kind) == "stopped":
                self.steward.call(f"start_{kind}", {})

    def module(self, kind: str) -> dict[str, Any]:
        """Status of a module."""
        modules = self.steward.call("get_status", {"details": True})["modules"]
        return dict(next(one for one in modules if one["module"] == kind))

    def phase(self, kind: str) -> str:
        """Phase of a module."""
        return str(self.module(kind)["phase"])

    def record(self) -> None:
        """Record a task."""
        self.use("http", "2025-11-25", "notification")
        self.prepare("move_ee")
        self.steward.call("start_recording", {})
        self.steward.call("run_task", TASK)
        self.files = list(self.steward.call("stop_recording", {})["files"])

    def prepare(self, call: str) -> None:
        """Make the call possible: nothing of the previous one is left."""
        wait_until(self.rests, 20.0, "the arm rests before the next call")
        is_running = self.phase("inference") != "stopped"
        if is_running and call != "run_task":
            self.steward.call("stop_inference", {})
        if call in ("pick", "push") and self._may_hold:
            self.steward.call("stop_all", {})  # the cubes of a new simulation lie on the table
            self._start()
            self._may_hold = False
        self._may_hold = self._may_hold or call in ("place", "run_task")
        if call in FROM_HOME:
            self.steward.call("move_to", {"name": "home"})
        elif call == "place":
            outcome = self.steward.call("run_task", TASK)["outcome"]
            assert outcome == "succeeded", outcome
        elif call == "start_all":
            self.steward.call("stop_all", {})
        elif call in SWITCHES or call == "set_instruction":
            self.steward.call("start_inference", {})
        elif call in STARTS:
            self.steward.call(call.replace("start", "stop"), {})

    def end_server(self) -> None:
        """End the server."""
        self._serves = ""
        self._stack.close()

    def close(self) -> None:
        """End everything."""
        self.push(False)
        self.end_server()
        self._executor.shutdown(timeout_sec=2.0)
        self._thread.join(timeout=2.0)
        self._node.destroy_node()
        self._context.try_shutdown()
