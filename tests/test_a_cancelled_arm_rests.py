"""The simulated FR3 is at rest soon after the call that moves it is cancelled: every call, way,
transport, and the protocols in use.

Judged by its measured joints. `play_recording` is in servers for replays only; a service that was
called cannot be recalled; previews and recordings move nothing.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from cancel_wire import HTTP_WAYS, TOKENS, HttpClient, StdioClient, Way, check_cell, served

from rn_testing.domain import free_ros_domain
from rn_testing.waiting import holds_within, wait_until
from roboneuron.config import default_text
from roboneuron.ros.environment import prepare_environment

sys.path.pop(0)

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(300)]
REST_S = 3.0
"""Deceleration, the window in which rest is measured, and a busy machine."""
WINDOW_S, STILL_RAD, MOVES_RAD = 0.3, 0.003, 0.01
LEAST_SAMPLES = 5
INSTRUCTION = "pick up the red cube"
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


def point(position: float) -> dict[str, Any]:
    points = [{"positions": [position], "time_from_start": 6.0}]
    return {"message": {"joint_names": ["fr3_joint1"], "points": points}}


CALLS: dict[str, cycle[tuple[str, dict[str, Any]]]] = {
    "move_joints": cycle(
        ("move_joints", {"positions": {"fr3_joint1": one}, "duration_s": 6}) for one in (0.6, -0.6)
    ),
    "trajectory": cycle(("publish_joint_trajectory", point(one)) for one in (0.6, -0.6)),
    "move_ee": cycle(("move_ee", {"dz_m": one, "duration_s": 5}) for one in (-0.1, 0.1)),
    "posture": cycle(("move_to", {"name": one}) for one in ("left", "right")),
    "straight": cycle(("move_to", {"name": one}) for one in ("far", "near")),
    "place": cycle([("place", {"dx_m": 0.0, "dy_m": -0.12})]),
    "run_task": cycle([("run_task", {"instruction": INSTRUCTION, "until": NEVER, "max_s": 60})]),
    "start_inference": cycle([("start_inference", {"instruction": INSTRUCTION})]),
}
"""Two targets each, so that every call has a way to go."""
WITH_POLICY = ("run_task", "start_inference")
START_S = 30.0


class Arm:
    """Measured joints of the arm, and the server that moves it."""

    def __init__(self, folder: Path) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import JointState

        domain = free_ros_domain()
        self.folder = folder
        self.environment = {"ROS_DOMAIN_ID": str(domain), "XDG_STATE_HOME": str(folder)}
        self._seen: deque[tuple[float, list[float]]] = deque(maxlen=200)
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node("judge", namespace="fr3", context=self._context)
        self._node.create_subscription(JointState, "joint_states", self._take, 50)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()
        self._stack = ExitStack()
        self._transport = ""
        self.steward: Any = None
        self.client: Any = None

    def _take(self, message: Any) -> None:
        self._seen.append((time.monotonic(), list(message.position)))

    def _travel(self) -> float | None:
        """Largest change of a joint within the newest window [rad or m]; None without
        measurements that fill it.
        """
        now_s, seen = time.monotonic(), tuple(self._seen)
        if not seen or now_s - seen[-1][0] > WINDOW_S / 2:
            return None
        inside = [one for one in seen if one[0] >= now_s - WINDOW_S]
        if len(inside) < LEAST_SAMPLES or inside[-1][0] - inside[0][0] < WINDOW_S / 2:
            return None
        return max(max(one) - min(one) for one in zip(*(j for _, j in inside), strict=True))

    def rests(self) -> bool:
        travel = self._travel()
        return travel is not None and travel < STILL_RAD

    def moves(self) -> bool:
        return (self._travel() or 0.0) > MOVES_RAD

    def use(self, transport: str, version: str, way: Way) -> HttpClient | StdioClient:
        """A client of the running server, or of a new one; the arm is started."""
        wanted = transport if transport == "http" else f"{transport} {version}"
        if self._transport != wanted:
            self.end_server()
            configuration = self.folder / "arm.toml"
            configuration.write_text(default_text() + CONFIG.format(folder=self.folder) + TOKENS)
            server = served(configuration, self.environment, transport=transport)
            process, self._url = self._stack.enter_context(server)
            if transport == "http":
                self.steward = HttpClient(self._url, "2025-11-25")
            else:
                self.steward = self.client = StdioClient(process, version)
            self._transport = wanted
            for kind in ("robot", "perception", "control"):
                self.steward.call(f"start_{kind}", {})
        client = self.client if transport == "stdio" else HttpClient(self._url, version)
        if way == "client killed" and transport == "stdio":
            self._transport = ""  # the server ends with its client
        return client

    def phase(self, kind: str) -> str:
        modules = self.steward.call("get_status", {})["modules"]
        return str(next(one["phase"] for one in modules if one["module"] == kind))

    def prepare(self, call: str) -> None:
        """Make the call possible: nothing of the previous one is left."""
        wait_until(self.rests, 20.0, "the arm rests before the next call")
        is_running = self.phase("inference") != "stopped"
        if is_running and call != "run_task":
            self.steward.call("stop_inference", {})
        if call == "place":
            task = {"instruction": INSTRUCTION, "until": HELD, "on_end": "stop", "max_s": 60}
            outcome = self.steward.call("run_task", task)["outcome"]
            assert outcome == "succeeded", outcome
        elif call == "straight":
            self.steward.call("move_to", {"name": "home"})

    def end_server(self) -> None:
        self._stack.close()
        self._transport = ""

    def close(self) -> None:
        self.end_server()
        self._executor.shutdown(timeout_sec=2.0)
        self._thread.join(timeout=2.0)
        self._node.destroy_node()
        self._context.try_shutdown()


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arm]:
    folder = tmp_path_factory.mktemp("arm")
    prepare_environment(folder / "ros")
    made = Arm(folder)
    yield made
    made.close()


def cells() -> Iterator[tuple[str, str, Way, str]]:
    """Transport, protocol, way, call. `place` picks up a cube first: for a few only."""
    for version in ("2025-06-18", "2025-11-25", "2026-07-28"):
        for way in HTTP_WAYS:
            if way == "session deleted" and version == "2026-07-28":
                continue  # it has no sessions
            for call in CALLS:
                if call != "place" or way in ("notification", "stream closed"):
                    yield "http", version, way, call
    for version in ("2025-11-25", "2026-07-28"):
        for call in CALLS:
            yield "stdio", version, "notification", call
        for call in ("move_joints", "run_task"):
            yield "stdio", version, "client killed", call


def is_none(way: Way, version: str, call: str) -> bool:
    """True if this way is no cancellation of this call in the protocol: a start goes on when its
    client's stream is closed, and is ended by the lease if the client stays away.
    """
    closed = way in ("stream closed", "client killed")
    return call == "start_inference" and closed and version != "2026-07-28"


@pytest.mark.parametrize(
    ("transport", "version", "way", "call"),
    [pytest.param(*row, id="-".join(row).replace(" ", "_")) for row in cells()],
)
def test_an_arm_rests_after_its_call_is_cancelled(
    arm: Arm, transport: str, version: str, way: Way, call: str
) -> None:
    client = arm.use(transport, version, way)
    arm.prepare(call)
    if call == "start_inference":
        check_start(arm, client, way)
    else:
        check_cell(client, way, next(CALLS[call]), arm.moves, arm.rests, REST_S)


def check_start(arm: Arm, client: HttpClient | StdioClient, way: Way) -> None:
    """A start of a policy that is cancelled starts nothing, and nothing moves."""
    is_seen = client.transport == "http"  # over stdio the answer of the start would be taken
    client.begin(*next(CALLS["start_inference"]))
    if is_seen:
        wait_until(lambda: arm.phase("inference") == "starting", START_S, "the start begins")
    client.cancel(way)
    if way == "wrong id" or is_none(way, client.version, "start_inference"):
        wait_until(lambda: arm.phase("inference") == "running", START_S, "the start goes on")
    else:
        wait_until(lambda: arm.phase("inference") == "stopped", START_S, "the start has ended")
        assert not holds_within(arm.moves, 1.0), "a cancelled start moves the arm"
    client.leave_call()
    print(f"{client.transport} {client.version} {way} start_inference: {arm.phase('inference')}")
