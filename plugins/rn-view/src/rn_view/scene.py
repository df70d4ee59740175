"""The robot and what surrounds it, in three dimensions, on one page."""

from __future__ import annotations

import io
import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rn_view.measured import MeasuredTopics, TcpTrack
from roboneuron import ArmProfile, RobotProfile
from roboneuron.feature import Config, MotionRules, motion_rules

if TYPE_CHECKING:
    import viser
    import yourdfpy

log = logging.getLogger(__name__)
F64 = NDArray[np.float64]
_BOX_RGB, _OBSTACLE_RGB, _ZONE_RGB, _TARGET_RGB = (
    (40, 130, 200),
    (150, 140, 125),
    (210, 60, 50),
    (235, 120, 20),
)
_TRAIL_RGB, _CAMERA_RGB = (40, 160, 110), (90, 90, 100)
_FRUSTUM_M = 0.12
_TARGET_M = 0.018
_BESIDE_TCP_M = np.array([0.0, 0.0, 0.12])
"""Where the name of an arm stands, from its TCP."""
_PHONE_PX = 576
"""viser puts the panel over the lower part of a page up to this wide."""
_BELOW_M = 1.0
"""There one looks at a place so far below the workspace, which then is above the panel."""


class RobotModel:
    """A robot's kinematics and shapes from its URDF.

    Raises:
        ValueError: yourdfpy cannot read the URDF.
    """

    def __init__(self, profile: RobotProfile) -> None:
        import yourdfpy  # heavy

        self.profile = profile
        self.urdf: yourdfpy.URDF = yourdfpy.URDF.load(io.BytesIO(profile.urdf.encode()))

    def configuration(self, joints: Mapping[str, float]) -> F64:
        """Joint positions in the order of the URDF; 0 for an unknown joint."""
        return np.array([joints.get(name, 0.0) for name in self.urdf.actuated_joint_names])

    def tcps_of(self, joints: Mapping[str, float]) -> dict[str, F64]:
        """TCP pose (4, 4) of each arm in the base frame at these positions; leaves the model in
        them.
        """
        self.urdf.update_cfg(self.configuration(joints))
        base = self.profile.base_link
        return {
            arm.name: np.asarray(self.urdf.get_transform(arm.tcp_link, base), dtype=np.float64)
            for arm in self.profile.each_arm
        }


class ArmScene:
    """The measured TCP of one arm, its trail, and where it was sent last; on one page.

    Args:
        scene: of the page.
        arm: whose.
    """

    def __init__(self, scene: viser.SceneApi, arm: ArmProfile) -> None:
        self._scene, self._arm = scene, arm
        self.place = f"/{arm.name}" if arm.name else ""
        self._tcp = scene.add_frame(
            f"{self.place}/tcp", axes_length=0.08, axes_radius=0.004, visible=False
        )
        self._label = (
            scene.add_label(f"{self.place}/label", arm.name, font_screen_scale=0.8, visible=False)
            if arm.name
            else None
        )
        self._target = scene.add_icosphere(
            f"{self.place}/target",
            radius=_TARGET_M,
            color=_TARGET_RGB,
            opacity=0.75,
            visible=False,
        )
        self._trail: viser.LineSegmentsHandle | None = None
        self._shown: tuple[object, int] = (None, 0)

    def target(self, position_m: F64) -> None:
        """Show the position that the TCP was sent to [m]."""
        self._target.position = position_m
        self._target.visible = True

    def update(self, track: TcpTrack, joints: Mapping[str, float]) -> None:
        """Show the newest measurement."""
        if track.pose is not None and track.pose is not self._shown[0]:
            self._tcp.position, self._tcp.wxyz = track.pose
            self._tcp.visible = True
            if self._label is not None:
                # a label does not move with the frame that it is in
                self._label.position = track.pose[0] + _BESIDE_TCP_M
                self._label.visible = True
        gripper = self._arm.gripper
        if self._label is not None and gripper is not None and gripper.joint in joints:
            text = f"{self._arm.name}: {gripper.to_opening(joints[gripper.joint]):.0%} open"
            if self._label.text != text:
                self._label.text = text
        trail = list(track.trail)
        mark = len(trail) + hash(trail[-1].tobytes()) if trail else 0
        if len(trail) > 1 and mark != self._shown[1]:
            points = np.stack([trail[:-1], trail[1:]], axis=1)
            if self._trail is None:
                self._trail = self._scene.add_line_segments(
                    f"{self.place}/trail",
                    points=points,
                    colors=_TRAIL_RGB,
                    thickness=2.0,
                    thickness_units="screen",
                )
            self._trail.points = points.astype(np.float32)
        if self._trail is not None:
            self._trail.visible = len(trail) > 1  # none yet at the beginning of a recording
        self._shown = (track.pose, mark)


class PageScene:
    """What one page shows in three dimensions; `update` moves it. Used by one thread at a time."""

    def __init__(self, client: viser.ClientHandle, profile: RobotProfile, config: Config) -> None:
        from viser.extras import ViserUrdf  # heavy

        self._scene = client.scene
        self._profile = profile
        self._joints: object = None
        self._target_at: Mapping[str, float] = {}
        self._model = RobotModel(profile) if profile.urdf else None
        self._arm = (
            ViserUrdf(client, self._model.urdf, root_node_name="/robot")
            if self._model is not None
            else None
        )
        if self._model is not None:
            home = (
                {}
                if profile.home_rad is None
                else dict(zip(profile.arm_joints, profile.home_rad, strict=True))
            )
            self._move(home)
        self._arms = {arm.name: ArmScene(self._scene, arm) for arm in profile.each_arm}
        self._pictures = {
            camera.name: self._add_camera(camera)
            for camera in profile.cameras
            if camera.calibration
        }
        limits = motion_rules(config.limits, profile)
        self._add_limits(limits, config)
        self._look_from(client, limits)

    def update(self, measured: MeasuredTopics) -> None:
        """Show the newest measurements."""
        if self._model is not None and measured.joints is not self._joints:
            self._joints = measured.joints
            self._move(measured.joints)
        if (
            self._model is not None
            and measured.commanded
            and measured.commanded is not self._target_at
        ):
            self._target_at = measured.commanded
            poses = self._model.tcps_of({**measured.joints, **measured.commanded})
            for arm, pose in poses.items():
                self._arms[arm].target(pose[:3, 3])
        for arm, track in measured.tracks.items():
            self._arms[arm].update(track, measured.joints)

    def show_picture(self, camera: str, pixels: NDArray[np.uint8]) -> None:
        """Show a picture at the pose of its camera."""
        if camera in self._pictures:
            self._pictures[camera].image = pixels

    def _move(self, joints: Mapping[str, float]) -> None:
        assert self._model is not None
        assert self._arm is not None
        self._arm.update_cfg(self._model.configuration(joints))

    def _add_camera(self, camera: Any) -> Any:
        calibration = camera.calibration
        place = self._mount(calibration.mount)
        turn = _wxyz(calibration.T_mount_camera[:3, :3])
        return self._scene.add_camera_frustum(
            f"{place}{camera.name}",
            fov=2.0 * float(np.arctan2(camera.height / 2.0, calibration.intrinsics[1, 1])),
            aspect=camera.width / camera.height,
            scale=_FRUSTUM_M if calibration.mount == "base" else _FRUSTUM_M / 3.0,
            thickness=1.5,
            thickness_units="screen",
            color=_CAMERA_RGB,
            wxyz=turn,
            position=calibration.T_mount_camera[:3, 3],
        )

    def _mount(self, mount: str) -> str:
        """Scene path of the frame that a camera is mounted on, with a trailing "/"."""
        if mount == "base":
            return "/cameras/"
        arm = mount.removesuffix("tcp").removesuffix("/") or next(iter(self._arms))
        return f"{self._arms[arm].place}/tcp/"

    def _add_limits(self, limits: MotionRules, config: Config) -> None:
        """Show the workspace box as lines, and forbidden zones and obstacles as boxes."""
        if np.isfinite(limits.lower_m).all() and np.isfinite(limits.upper_m).all():
            lower, upper = limits.lower_m, limits.upper_m
            self._scene.add_line_segments(
                "/workspace",
                points=_edges(lower, upper),
                colors=_BOX_RGB,
                thickness=1.5,
                thickness_units="screen",
            )
            # the corner beside which there is room, on a phone too
            behind = np.array([lower[0], upper[1], upper[2]])
            self._scene.add_label(
                "/workspace/label", "workspace of the TCP", position=behind, font_screen_scale=0.8
            )
        for zone in limits.zones:
            self._add_box(f"/zones/{zone.name}", zone.lower_m, zone.upper_m, _ZONE_RGB, 0.25)
        collision = limits.collision
        boxes = collision.obstacles if collision is not None else ()
        for box in boxes:
            self._add_box(f"/obstacles/{box.name}", box.lower_m, box.upper_m, _OBSTACLE_RGB, 0.35)
        floor_m = min((float(box.lower_m[2]) for box in boxes), default=0.0)
        self._scene.add_grid(
            "/grid", 6.0, 6.0, cell_size=0.1, section_size=0.5, position=(0.0, 0.0, floor_m)
        )

    def _add_box(
        self, name: str, lower: F64, upper: F64, rgb: tuple[int, int, int], opacity: float
    ) -> None:
        self._scene.add_box(
            name,
            color=rgb,
            dimensions=upper - lower,
            position=(lower + upper) / 2.0,
            opacity=opacity,
            cast_shadow=False,
        )

    def _look_from(self, client: viser.ClientHandle, limits: MotionRules) -> None:
        box = np.stack([limits.lower_m, limits.upper_m])
        centre = (
            box.mean(axis=0) * np.array([0.8, 1.0, 0.9])
            if np.isfinite(box).all()
            else np.array([0.3, 0.0, 0.3])
        )
        is_phone = client.camera.image_width <= _PHONE_PX
        client.camera.position = centre + np.array([0.95, -1.15, 0.65]) * (
            1.25 if is_phone else 0.85
        )
        client.camera.look_at = centre - np.array([0.0, 0.0, _BELOW_M * is_phone])


def _edges(lower: F64, upper: F64) -> F64:
    """The twelve edges of a box, (12, 2, 3)."""
    corners = [np.where([i & 1, i & 2, i & 4], upper, lower) for i in range(8)]
    pairs = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
    return np.array([[corners[a], corners[b]] for a, b in pairs])


def _wxyz(rotation: F64) -> F64:
    from viser.transforms import SO3  # heavy

    return np.asarray(SO3.from_matrix(rotation).wxyz, dtype=np.float64)
