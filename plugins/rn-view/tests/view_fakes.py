"""A source and an operator without a server: a small arm, pictures with a number in them, and what
was pressed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rn_standard.http.options import HttpOptions
from rn_standard.http.tokens import TokenTable
from rn_view.diagnostics.event_list import EventList
from rn_view.options import ViewOptions
from rn_view.sources.records import RobotRecords
from rn_view.sources.source import ModuleRow, PageState
from rn_view.web.access import ViewAccess, host_rules
from roboneuron import CameraCalibration, CameraProfile, JointLimits, RobotProfile, Workspace
from roboneuron.config import Config, parse_config
from roboneuron.server.tool import Holder

URDF = """
<robot name="twolink">
  <link name="base"><visual><geometry><cylinder radius="0.08" length="0.1"/></geometry></visual></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.05"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <link name="upper"><visual><origin xyz="0 0 0.2"/><geometry><box size="0.06 0.06 0.4"/></geometry></visual></link>
  <joint name="lift" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <link name="fore"><visual><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.05 0.05"/></geometry></visual></link>
  <joint name="tip" type="fixed"><parent link="fore"/><child link="tcp"/><origin xyz="0.4 0 0"/></joint>
  <link name="tcp"/>
</robot>
"""  # noqa: E501
CONFIG = """
[robot]
name = "twolink"
"""
HOME = {"turn": 0.3, "lift": 0.2}


def profile() -> RobotProfile:
    """A turning arm of two links with one camera at its side."""
    two = np.full(2, 2.0)
    pose = np.eye(4)
    pose[:3, 3] = (1.0, 0.0, 0.5)
    intrinsics = np.array([[200.0, 0.0, 80.0], [0.0, 200.0, 60.0], [0.0, 0.0, 1.0]])
    return RobotProfile(
        name="twolink",
        urdf=URDF,
        base_link="base",
        tcp_link="tcp",
        arm_joints=("turn", "lift"),
        limits=JointLimits(lower=-two, upper=two, velocity=two, acceleration=two, effort=two),
        home_rad=np.array([0.3, 0.2]),
        cameras=(
            CameraProfile(
                name="front",
                role="primary",
                frame_id="front",
                width=160,
                height=120,
                calibration=CameraCalibration(
                    intrinsics=intrinsics, mount="base", T_mount_camera=pose
                ),
            ),
        ),
        workspace=Workspace(lower_m=np.array([0.1, -0.4, 0.1]), upper_m=np.array([0.6, 0.4, 0.7])),
    )


class FakeSource:
    """A source that the test feeds: `send` brings a message to whoever subscribed."""

    label = "live"
    playback = None

    def __init__(self) -> None:
        self.records: RobotRecords | None = None
        self.limited: tuple[str, dict[str, int]] = ("", {})
        self.shown_events = EventList()
        self.subscribed: dict[str, Callable[[Any], None]] = {}
        self.stops: list[str] = []
        self.stopped = threading.Event()
        self.modules = (
            ModuleRow(kind="robot", health="ok", chosen="twolink", rate_hz=100.0),
            ModuleRow(
                kind="inference",
                health="failing",
                text="<b>lost</b>",
                rate_hz=5.0,
                latency_ms=40.0,
                dropped=3,
            ),
        )

    def now_s(self) -> float:
        return time.monotonic()

    def config(self) -> Config:
        return parse_config(CONFIG)

    def profile(self) -> RobotProfile:
        return profile()

    def snapshot(self) -> PageState:
        cause = self.stops[-1] if self.stops else ""
        return PageState(
            modules=self.modules,
            is_latched=bool(self.stops),
            cause=cause,
            instruction="lift the <cup>",
            limit=self.limited[0],
            limit_counts=self.limited[1],
        )

    @property
    def release_command(self) -> str:
        return f"roboneuron estop --reset --state /var/lib/robots/{'long-name-' * 4}state"

    def is_latched(self) -> bool:
        return bool(self.stops)

    def poll(self) -> None:
        pass

    def subscribe(
        self, message_type: type, topic: str, callback: Callable[[Any], None]
    ) -> Callable[[], None]:
        self.subscribed[topic] = callback
        return lambda: self.subscribed.__delitem__(topic)

    def press_stop(self, who: str) -> str:
        self.stops.append(who)
        self.stopped.set()
        return "Latched."

    def send(self, topic: str, message: Any) -> None:
        callback = self.subscribed.get(topic)
        if callback is not None:
            callback(message)


class FakeOperator:
    """Keeps the calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, str, dict[str, Any]]] = []
        self.left: list[str] = []
        self.open: list[str] = []
        self.called = threading.Event()
        self.lent: dict[str, Any] = {}
        self.tools: dict[str, dict[str, Any]] = {}
        """What tools say that were asked by `fetch`; a page has these only."""
        self.refusal = ""
        """What every call but that of `take_over` says; empty: it succeeds."""

    def lend(self, name: str, source: Any) -> bool:
        self.lent[name] = source
        return True

    def call(self, holder: Holder, tool: str, arguments: dict[str, Any]) -> Future[str]:
        done: Future[str] = Future()
        self.calls.append((holder.who, tool, arguments))
        self.called.set()
        done.set_result("" if tool == "take_over" else self.refusal)
        return done

    def fetch(self, holder: Holder, tool: str) -> Future[dict[str, Any]]:
        done: Future[dict[str, Any]] = Future()
        done.set_result(self.tools.get(tool, {}))
        return done

    def has(self, tool: str) -> bool:
        return tool in self.tools

    @contextmanager
    def present(self, holder: Holder) -> Iterator[None]:
        self.open.append(holder.who)
        try:
            yield
        finally:
            self.open.remove(holder.who)

    def leave(self, holder: Holder) -> None:
        self.left.append(holder.who)


def admission(options: ViewOptions, *tokens: tuple[str, str]) -> ViewAccess:
    """Access with these tokens by role; without any, everybody is let in."""
    table = TokenTable([(token, Holder(who=f"the {role}", role=role)) for token, role in tokens])
    return ViewAccess(tokens=table, rules=host_rules(options, HttpOptions()))


def picture(shade: int) -> Any:
    """An image message of one grey level, stamped now."""
    from sensor_msgs.msg import Image

    pixels: NDArray[np.uint8] = np.full((120, 160, 3), shade, dtype=np.uint8)
    message = Image(width=160, height=120, step=480, encoding="rgb8")
    message.data = pixels.tobytes()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
    return message


def joints(**positions: float) -> Any:
    """A joint state."""
    from sensor_msgs.msg import JointState

    return JointState(name=list(positions), position=[float(value) for value in positions.values()])


class MaintenanceSwitch:
    """A maintenance mode without a robot."""

    state: str | None = None

    def begin(self, who: str, role: str, reason: str) -> str:
        self.state = f"{who} took the robot out of service: {reason}"
        return self.state

    def end(self, who: str, role: str) -> None:
        self.state = None
