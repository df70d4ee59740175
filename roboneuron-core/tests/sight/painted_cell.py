"""A server as features see it, whose cameras show painted cubes, without ROS."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np
from numpy.typing import NDArray

from rn_testing.fakes.painted_table import (
    SIDE_PX,
    Cubes,
    overhead_camera,
    paint_cubes,
    side_camera,
)
from roboneuron import (
    ArmProfile,
    CameraCalibration,
    CameraProfile,
    GripperProfile,
    JointSample,
    LocatedObject,
    LocatorSpec,
    RobotProfile,
)
from roboneuron.modules.report import Report
from roboneuron.server.clock import RobotClock
from roboneuron.sight.options import SightOptions
from roboneuron.sight.plugin import LOCATORS
from roboneuron.supervisor.changes import Event
from roboneuron.tools.inspect.sight_feature import Sight

CAMERAS = {"above": overhead_camera(), "side": side_camera()}
PERIOD_S = 0.02
GRIPPER = GripperProfile(joint="finger", closed_position=0.0, open_position=0.04)


@cache
def picture(name: str, cubes: tuple[tuple[str, tuple[float, float, float]], ...]) -> Any:
    """Painting takes longer than looking."""
    return paint_cubes(CAMERAS[name], dict(cubes))


def message(image: NDArray[np.uint8], age_s: float = 0.0) -> Any:
    """sensor_msgs/Image, as far as it is read."""
    height, width = image.shape[:2]
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp(age_s), frame_id="optical"),
        data=image.tobytes(),
        width=width,
        height=height,
        step=3 * width,
        encoding="rgb8",
        is_bigendian=False,
    )


def depth_message(depth_m: NDArray[np.float32], age_s: float | None = None) -> Any:
    """The depth of a picture, as far as it is read; without an age it has the picture's stamp."""
    made = message(np.zeros((*depth_m.shape, 3), np.uint8), age_s or 0.0)
    made.data, made.encoding, made.step = depth_m.tobytes(), "32FC1", 4 * depth_m.shape[1]
    made.header = None if age_s is None else made.header
    return made


def pose_message(position: Sequence[float], xyzw: Sequence[float] = (1, 0, 0, 0)) -> Any:
    """geometry_msgs/PoseStamped, as far as it is read."""
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp(0.0)),
        pose=SimpleNamespace(
            position=SimpleNamespace(**dict(zip("xyz", map(float, position), strict=True))),
            orientation=SimpleNamespace(**dict(zip("xyzw", map(float, xyzw), strict=True))),
        ),
    )


def stamp(age_s: float) -> Any:
    sec, nanosec = divmod(int((time.time() - age_s) * 1e9), 1_000_000_000)
    return SimpleNamespace(sec=sec, nanosec=nanosec)


@dataclass
class PaintedCell:
    """Two cameras over a table, one above and one at the side, and arms that are measured.

    Attributes:
        cubes: colour -> x, y, yaw.
        ages_s: age of each camera's pictures; a camera that is missing sends none.
        mounts: where a camera is mounted instead of the base; None: not calibrated.
        tcps: position of each arm that is measured.
        arms: names of the arms; none for a single one.
        has_gripper: the arms have one.
        opening, commanded: of the gripper.
        perception, robot, control: phases of the modules.
        depths: message of each camera's depth.
        locator: the chosen one.
        takers: the end of each topic that is subscribed to, and what takes its messages.
        patches: rows and columns of a camera's pictures that something grey covers.
        light: factors of red, green and blue of the lamp over the table.
        events: of the host.
    """

    cubes: Cubes = field(default_factory=dict)
    ages_s: dict[str, float] = field(default_factory=lambda: {"above": 0.0, "side": 0.0})
    mounts: dict[str, str | None] = field(default_factory=dict)
    tcps: Mapping[str, Sequence[float]] = field(default_factory=lambda: {"": (0.3, 0.0, 0.4)})
    arms: tuple[str, ...] = ()
    has_gripper: bool = True
    opening: float = 1.0
    commanded: float = 1.0
    perception: str = "running"
    robot: str = "running"
    control: str = "running"
    depths: dict[str, Any] = field(default_factory=dict)
    locator: LocatorSpec = LOCATORS[0]
    takers: list[tuple[str, Callable[[Any], None]]] = field(default_factory=list)
    lock: Any = field(default_factory=threading.Lock)
    sending: threading.Thread | None = None
    patches: dict[str, tuple[slice, slice]] = field(default_factory=dict)
    light: tuple[float, float, float] = (1.0, 1.0, 1.0)
    events: Any = field(default_factory=lambda: SimpleNamespace(change=Event(), call_ended=Event()))

    def profile(self) -> RobotProfile:
        gripper = GRIPPER if self.has_gripper else None
        arms = tuple(
            ArmProfile(
                name=name,
                joints=(f"{name}_j",),
                base_link="base",
                tcp_link=f"{name}_tcp",
                gripper=gripper,
            )
            for name in self.arms
        )
        return RobotProfile(
            name="painted",
            tcp_link="tcp",
            base_link="base",
            arm_joints=tuple(arm.joints[0] for arm in arms) or ("j",),
            arms=arms,
            gripper=gripper,
            cameras=tuple(
                CameraProfile(
                    name=name,
                    role=name,
                    frame_id=name,
                    width=SIDE_PX,
                    height=SIDE_PX,
                    calibration=self._calibration(name, made),
                )
                for name, made in CAMERAS.items()
            ),
        )

    def _calibration(self, name: str, made: CameraCalibration) -> CameraCalibration | None:
        mount = self.mounts.get(name, "base")
        return None if mount is None else replace(made, mount=mount)

    @property
    def exposed(self) -> list[Any]:
        """Asked for at the beginning of a look: what is being sent shows the cell of before."""
        with self.lock:
            pass
        return [SimpleNamespace(robot="painted", namespace="painted", profile=self.profile())]

    def joints(self, exposed: Any, timeout_s: float = 0.0) -> Any:
        position = np.array([GRIPPER.to_position(self.opening)])
        return JointSample(names=("finger",), position=position)

    def subscribe(
        self, kind: Any, topic: str, take: Callable[[Any], None], **_: Any
    ) -> Callable[[], None]:
        """Its messages come again and again, on a thread, until it ends."""
        taker = (topic.removeprefix("/painted/"), take)
        with self.lock:
            self.takers.append(taker)
            self._send(*taker)
            if self.sending is None or not self.sending.is_alive():
                self.sending = threading.Thread(target=self._keep_sending, daemon=True)
                self.sending.start()

        def end() -> None:
            with self.lock:
                self.takers.remove(taker)

        return end

    def _keep_sending(self) -> None:
        while True:
            time.sleep(PERIOD_S)
            with self.lock:
                if not self.takers:
                    return
                for taker in self.takers:
                    self._send(*taker)

    def _send(self, part: str, take: Callable[[Any], None]) -> None:
        """The next message of a topic."""
        if part.endswith("ee_pose"):
            arm = part.removesuffix("ee_pose").rstrip("/")
            for name in self.ages_s:  # painted before the pose is stamped: it takes long
                picture(name, tuple(self.cubes.items()))
            if arm in self.tcps:
                take(pose_message(self.tcps[arm]))
        elif part.endswith("image"):
            name = part.split("/")[1]
            if name in self.ages_s:
                image = picture(name, tuple(self.cubes.items())).copy()
                if name in self.patches:
                    image[self.patches[name]] = 120
                made = message((image * self.light).astype(np.uint8), self.ages_s[name])
                for _, take_depth in [t for t in self.takers if t[0] == f"camera/{name}/depth"]:
                    depth = copy(self.depths[name])
                    depth.header = made.header if depth.header is None else depth.header
                    take_depth(depth)
                take(made)

    def view(self, kind: str) -> Any:
        phases = {"perception": self.perception, "robot": self.robot, "control": self.control}
        plan = SimpleNamespace(names={"cameras": "above, side"})
        metrics = {"gripper_commanded": f"{self.commanded:g}"}
        return SimpleNamespace(
            phase=phases.get(kind, "running"), plan=plan, report=Report(metrics=metrics)
        )

    @property
    def host(self) -> Any:
        return SimpleNamespace(
            config=SimpleNamespace(
                namespace="painted",
                robot=SimpleNamespace(name="painted"),
                options=lambda name: {},
                control=None,
            ),
            loop=SimpleNamespace(camera_roles=lambda: {"above": "primary", "side": "side"}),
            modules=SimpleNamespace(view=self.view),
            clock=lambda namespace: RobotClock(),
            registry=SimpleNamespace(get=lambda kind, name: self.locator),
            gate=self,
            features=SimpleNamespace(loaded={}),
            events=self.events,
            graph=SimpleNamespace(
                publishers=lambda topic: [name for name in self.depths if f"/{name}/" in topic]
            ),
            subscribe=self.subscribe,
        )

    def sight(self) -> tuple[Sight, dict[str, Any]]:
        """The feature, and its tools by name."""
        feature = Sight(SightOptions())
        return feature, {tool.name: tool for tool in feature.tools(self.host)}

    def call(self, tool: Any, **arguments: Any) -> Any:
        """What a tool answers."""

        async def run(work: Any, **_: Any) -> Any:
            return work(lambda _: None)

        context = SimpleNamespace(who="agent", role="operator", simulated=False, run=run)
        return anyio.run(tool.handler, tool.parsed(arguments), context)


class WaitingLocator:
    """A locator that is as slow as a test wants; `entered` when it is called, until `free`."""

    entered = threading.Event()
    free = threading.Event()

    def __init__(self, config: None) -> None:
        pass

    def load(self) -> None:
        """See `Locator`."""

    def locate(self, images: Sequence[object]) -> Sequence[LocatedObject]:
        """See `Locator`."""
        self.entered.set()
        self.free.wait(30.0)
        return []

    def close(self) -> None:
        """See `Locator`."""
