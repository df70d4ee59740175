"""Recorded actions, played again into a simulation: through the control module with its controller and limits."""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import anyio
import numpy as np
from numpy.typing import NDArray

from rn_console.client import spawned_server
from rn_runs.episodes import Streams, read_streams
from roboneuron import ConfigurationError, InvalidInputError, NotReadyError
from roboneuron.config import Config, load_config
from roboneuron.ros.environment import prepare_environment

if TYPE_CHECKING:
    from mcp import Client

F64 = NDArray[np.float64]
_MOST_GAP_S = 1.0
"""A longer pause between two recorded actions is shortened to this: control holds meanwhile."""
_SETTLE_S = 1.0


@dataclass(frozen=True, slots=True)
class Played:
    """How it went.

    Attributes:
        sent: actions.
        dropped: what control did not act on, by reason.
        end_m: distance between the TCP's last recorded and last measured position, each from its own beginning [m].
        path_m: length of the recorded path [m].
    """

    sent: int
    dropped: dict[str, int]
    end_m: float | None
    path_m: float


def play(files: Sequence[Path], config_path: Path | None) -> Played:
    """Start a server with a simulated robot, play, and stop everything.

    Raises:
        ConfigurationError: the configured driver is not a simulation.
        InvalidInputError: the run holds no actions.
        NotReadyError: robot or control did not start.
    """
    config = load_config(config_path)
    if config.robot.driver != "simulated":
        raise ConfigurationError(
            f"The configured driver is {config.robot.driver!r}: recorded actions are played into a simulation only.",
            hint='Give a configuration with driver = "simulated" in [robot].',
        )
    streams = read_streams(files)
    if not streams.actions:
        raise InvalidInputError("The run holds no actions.")
    return anyio.run(_play, config, config_path, streams)


async def _play(config: Config, config_path: Path | None, streams: Streams) -> Played:
    options = ["--config", str(config_path)] if config_path is not None else []
    with tempfile.TemporaryDirectory() as folder:
        async with spawned_server([*options, "--log-level", "error"], Path(folder) / "server.log") as client:
            for tool in ("start_robot", "start_control"):
                await _call(client, tool)
            before = await _control(client)
            measured = await anyio.to_thread.run_sync(_send, config.namespace, streams)
            after = await _control(client)
            with suppress(NotReadyError):
                await _call(client, "stop_all")
    dropped = {
        reason: count - int(before.get(reason, 0))
        for reason, count in after.items()
        if count > int(before.get(reason, 0))
    }
    recorded = np.array([pose[:3] for _, pose in streams.poses]).reshape(-1, 3)
    path_m = float(np.linalg.norm(np.diff(recorded, axis=0), axis=1).sum()) if len(recorded) > 1 else 0.0
    end_m = None
    if len(recorded) > 1 and len(measured) > 1:
        moved, wanted = measured[-1] - measured[0], recorded[-1] - recorded[0]
        end_m = float(np.linalg.norm(moved - wanted))
    return Played(len(streams.actions), dropped, end_m, path_m)


async def _call(client: Client, tool: str) -> dict[str, Any]:
    answer = await client.call_tool(tool, {})
    if answer.is_error:
        text = " ".join(getattr(block, "text", "") for block in answer.content)
        raise NotReadyError(f"{tool}: {text}")
    return dict(answer.structured_content or {})


async def _control(client: Client) -> dict[str, int]:
    status = await _call(client, "get_status")
    module = next(entry for entry in status["modules"] if entry["module"] == "control")
    return {str(reason): int(count) for reason, count in (module.get("dropped_by") or {}).items()}


def _send(namespace: str, streams: Streams) -> F64:
    """Publish the actions at their recorded pace; returns the TCP positions measured meanwhile, float64 (n, 3)."""
    prepare_environment()
    import rclpy  # heavy
    from geometry_msgs.msg import PoseStamped
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from std_msgs.msg import Float64MultiArray

    from roboneuron.ros.messages import to_action_message
    from roboneuron.ros.qos import NEWEST
    from roboneuron.ros.topics import ACTION, EE_POSE

    measured: list[tuple[float, float, float]] = []
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node(f"replay_{os.getpid()}", namespace=namespace, context=context)
    publisher = node.create_publisher(Float64MultiArray, ACTION, NEWEST)

    def on_pose(message: PoseStamped) -> None:
        position = message.pose.position
        measured.append((position.x, position.y, position.z))

    node.create_subscription(PoseStamped, EE_POSE, on_pose, NEWEST)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def spin() -> None:
        with suppress(ExternalShutdownException):
            executor.spin()

    spinning = threading.Thread(target=spin, daemon=True)
    spinning.start()
    try:
        until_s = time.monotonic() + 10.0
        while not (publisher.get_subscription_count() and measured):
            if time.monotonic() > until_s:
                raise NotReadyError("Control does not listen, or tells no pose.")
            time.sleep(0.02)
        due_s = time.monotonic()
        before_ns = streams.actions[0][0]
        for sent_ns, vector in streams.actions:
            due_s += min((sent_ns - before_ns) / 1e9, _MOST_GAP_S)
            before_ns = sent_ns
            time.sleep(max(0.0, due_s - time.monotonic()))
            publisher.publish(to_action_message(vector))
        time.sleep(_SETTLE_S)
    finally:
        executor.shutdown(timeout_sec=1.0)
        spinning.join(2.0)
        node.destroy_node()
        context.try_shutdown()
    return np.array(measured)
