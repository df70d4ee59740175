"""A server as features see it, whose cameras show painted cubes, without ROS."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np
from numpy.typing import NDArray

from rn_standard.sight.contract_cases import (
    SIDE_PX,
    Cubes,
    overhead_camera,
    paint_cubes,
    side_camera,
)
from rn_standard.sight.options import SightOptions
from rn_standard.sight.plugin import LOCATORS
from rn_standard.tools_inspect.sight_feature import Sight
from roboneuron import (
    ArmProfile,
    CameraCalibration,
    CameraProfile,
    GripperProfile,
    RobotProfile,
)
from roboneuron.modules.report import Report

CAMERAS = {"above": overhead_camera(), "side": side_camera()}
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
        perception: phase of the module.
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
    graph: object = None
    topics: list[str] = field(default_factory=list)

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
        return [SimpleNamespace(robot="painted", namespace="painted", profile=self.profile())]

    def joints(self, exposed: Any, timeout_s: float = 0.0) -> Any:
        position = np.array([GRIPPER.to_position(self.opening)])
        return SimpleNamespace(names=("finger",), position=position)

    def subscribe(
        self, kind: Any, topic: str, take: Callable[[Any], None], **_: Any
    ) -> Callable[[], None]:
        self.topics.append(topic)
        part = topic.removeprefix("/painted/")
        if part.endswith("ee_pose"):
            arm = part.removesuffix("ee_pose").rstrip("/")
            if arm in self.tcps:
                take(pose_message(self.tcps[arm]))
        elif part.endswith("image"):
            name = part.split("/")[1]
            if name in self.ages_s:
                image = picture(name, tuple(self.cubes.items()))
                take(message(image, self.ages_s[name]))
        return lambda: self.topics.remove(topic)

    def view(self, kind: str) -> Any:
        phases = {"perception": self.perception, "robot": self.robot}
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
            registry=SimpleNamespace(get=lambda kind, name: LOCATORS[0]),
            gate=self,
            graph=None,
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
