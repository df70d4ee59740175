"""The 3-D scene of a page: the robot, its limits, and what surrounds it."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rn_view.diagnostics.active_limits import LimitPlace, limit_place
from rn_view.sources.measured_topics import MeasuredTopics, TcpTrack
from rn_view.sources.source import PageState
from rn_view.visualization.predicted_path import PlannedChunk
from rn_view.visualization.robot_model import RobotModel
from roboneuron import ArmProfile, RobotProfile
from roboneuron.feature import Config, MotionRules, motion_rules

if TYPE_CHECKING:
    import viser
    from viser.extras import ViserUrdf

    from roboneuron import Obstacle

log = logging.getLogger(__name__)
F64 = NDArray[np.float64]
_BOX_RGB, _OBSTACLE_RGB, _ZONE_RGB, _TARGET_RGB = (
    (40, 130, 200),
    (150, 140, 125),
    (210, 60, 50),
    (235, 120, 20),
)
_TRAIL_RGB, _CAMERA_RGB = (40, 160, 110), (90, 90, 100)
_PATH_RGB, _ACTING_RGB = (150, 70, 210), (224, 49, 49)
_GHOST_RGBA = (0.92, 0.47, 0.08, 0.35)
_GHOST_FROM = 0.05
"""Distance of a commanded joint from the measured one [rad or m] from which the ghost is shown."""
_FRUSTUM_M = 0.12
_TARGET_M = 0.018
_BESIDE_TCP_M = np.array([0.0, 0.0, 0.12])
"""Position of an arm's name, from its TCP in the base frame."""


class ArmScene:
    """Measured TCP of one arm, its trail, its predicted path and its commanded position, on one
    page.

    Args:
        scene: scene of the page.
        arm: the arm.
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
        self._path: viser.LineSegmentsHandle | None = None
        self._shown: tuple[object, int] = (None, 0)

    def target(self, position_m: F64) -> None:
        """Show the commanded position of the TCP [m]."""
        self._target.position = position_m
        self._target.visible = True

    def show_path(self, points: F64 | None) -> None:
        """Show the predicted path of the running chunk [m] (k, 3); None hides it."""
        if points is None or len(points) < 2:
            if self._path is not None:
                self._path.visible = False
            return
        lines = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
        if self._path is None:
            name = f"{self.place}/predicted"
            self._path = _add_lines(self._scene, name, lines, _PATH_RGB, width_px=4.0)
        self._path.points = lines
        self._path.visible = True

    @property
    def tcp_m(self) -> F64:
        """Position at which the TCP is shown [m]."""
        return np.asarray(self._tcp.position, dtype=np.float64)

    def update(self, track: TcpTrack, joints: Mapping[str, float]) -> None:
        """Show the newest measurement."""
        if track.pose is not None and track.pose is not self._shown[0]:
            self._tcp.position, self._tcp.wxyz = track.pose
            self._tcp.visible = True
            if self._label is not None:
                # a label does not follow the frame that it belongs to
                self._label.position = track.pose[0] + _BESIDE_TCP_M
                self._label.visible = True
        gripper = self._arm.gripper
        opening = None if gripper is None else gripper.opening_in(joints)
        if self._label is not None and opening is not None:
            text = f"{self._arm.name}: {opening:.0%} open"
            if self._label.text != text:
                self._label.text = text
        trail = list(track.trail)
        mark = len(trail) + hash(trail[-1].tobytes()) if trail else 0
        if len(trail) > 1 and mark != self._shown[1]:
            points = np.stack([trail[:-1], trail[1:]], axis=1)
            if self._trail is None:
                name = f"{self.place}/trail"
                self._trail = _add_lines(self._scene, name, points, _TRAIL_RGB, width_px=2.0)
            self._trail.points = points.astype(np.float32)
        if self._trail is not None:
            self._trail.visible = len(trail) > 1  # empty at the beginning of a recording
        self._shown = (track.pose, mark)


class PageScene:
    """The 3-D scene of one page. Used by one thread at a time."""

    def __init__(
        self, client: viser.ClientHandle, profile: RobotProfile, config: Config, *, is_narrow: bool
    ) -> None:
        from viser.extras import ViserUrdf  # heavy

        self._scene = client.scene
        self._profile = profile
        self._joints: object = None
        self._measured: Mapping[str, float] = {}
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
        self._ghost: ViserUrdf | None = None
        self._client = client
        self._chunk: PlannedChunk | None = None
        self._boxes: dict[str, tuple[viser.BoxHandle, tuple[int, int, int], float]] = {}
        self._workspace: viser.LineSegmentsHandle | None = None
        self._limited: tuple[tuple[str, ...], str] = ((), "")
        self._limit = self._scene.add_label("/limit", "", font_screen_scale=1.0, visible=False)
        self._arms = {arm.name: ArmScene(self._scene, arm) for arm in profile.each_arm}
        self._pictures = {
            camera.name: self._add_camera(camera)
            for camera in profile.cameras
            if camera.calibration
        }
        limits = motion_rules(config.limits, profile)
        self._add_limits(limits, config)
        self._box = np.stack([limits.lower_m, limits.upper_m])
        self.look(is_narrow=is_narrow)

    def look(self, *, is_narrow: bool) -> None:
        """Look at the workspace; from farther away if the scene is higher than wide."""
        box = self._box
        centre = (
            box.mean(axis=0) * np.array([0.8, 1.0, 0.9])
            if np.isfinite(box).all()
            else np.array([0.3, 0.0, 0.3])
        )
        away = np.array([0.95, -1.15, 0.65]) * (1.25 if is_narrow else 0.85)
        self._client.camera.position = centre + away
        self._client.camera.look_at = centre

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
        self._show_ghost(measured)
        for arm, track in measured.tracks.items():
            self._arms[arm].update(track, measured.joints)

    def update_chunk(self, measured: MeasuredTopics, now_s: float) -> None:
        """Show the predicted path of the running chunk; `now_s` as `Source.now_s`."""
        chunk = measured.chunk
        if chunk is not None and chunk.is_over(now_s):
            chunk = None
        if chunk is self._chunk:
            return
        self._chunk = chunk
        forward = None if self._model is None else self._model.tcps_of
        paths = {} if chunk is None else chunk.paths(forward)
        for arm, scene in self._arms.items():
            scene.show_path(paths.get(arm))

    def update_limit(self, state: PageState) -> None:
        """Show the limit that acts, at its joint, zone, workspace box or TCP."""
        if (state.limits, state.limit) == self._limited:
            return
        self._limited = state.limits, state.limit
        place = limit_place(state.limits, state.limit, self._profile.arm_joints, tuple(self._boxes))
        for name, (box, rgb, opacity) in self._boxes.items():
            acts = name in place.zones
            box.color, box.opacity = (_ACTING_RGB, 0.6) if acts else (rgb, opacity)
        if self._workspace is not None:
            colours = _ACTING_RGB if place.box else _BOX_RGB
            shape = np.asarray(self._workspace.points).shape
            self._workspace.colors = np.full(shape, colours, dtype=np.uint8)
        self._limit.visible = bool(state.limits)
        if not state.limits:
            return
        where = ", ".join((*place.joints, *place.zones))
        self._limit.text = f"limit: {', '.join(state.limits)}{f' ({where})' if where else ''}"
        self._limit.position = self._limit_position(place)

    def _limit_position(self, place: LimitPlace) -> F64:
        """Position of the name of the limit [m]."""
        if place.zones:
            return np.asarray(self._boxes[place.zones[0]][0].position, dtype=np.float64)
        if place.joints and self._model is not None:
            found = self._model.joint_place(place.joints[0], self._measured)
            if found is not None:
                return found
        beside: F64 = next(iter(self._arms.values())).tcp_m + _BESIDE_TCP_M
        return beside

    def _show_ghost(self, measured: MeasuredTopics) -> None:
        """Show the robot at the commanded joint positions, if they differ from the measured
        ones.
        """
        self._measured = measured.joints
        if self._model is None or not measured.commanded or not measured.joints:
            if self._ghost is not None:
                self._ghost.show_visual = False
            return
        far = max(
            (
                abs(at - measured.joints[name])
                for name, at in measured.commanded.items()
                if name in measured.joints
            ),
            default=0.0,
        )
        if far < _GHOST_FROM:
            if self._ghost is not None:
                self._ghost.show_visual = False
            return
        if self._ghost is None:
            from viser.extras import ViserUrdf  # heavy

            self._ghost = ViserUrdf(
                self._client,
                self._model.urdf,
                root_node_name="/commanded",
                mesh_color_override=_GHOST_RGBA,
            )
        self._ghost.show_visual = True
        posture = {**measured.joints, **measured.commanded}
        self._ghost.update_cfg(self._model.configuration(posture))

    def show_picture(self, camera: str, pixels: NDArray[np.uint8]) -> None:
        """Show an image at the pose of its camera."""
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
        """Scene path of the frame on which a camera is mounted, with a trailing "/"."""
        if mount == "base":
            return "/cameras/"
        arm = mount.removesuffix("tcp").removesuffix("/") or next(iter(self._arms))
        return f"{self._arms[arm].place}/tcp/"

    def _add_limits(self, limits: MotionRules, config: Config) -> None:
        """Show the workspace box as lines, and forbidden zones and obstacles as boxes."""
        if np.isfinite(limits.lower_m).all() and np.isfinite(limits.upper_m).all():
            lower, upper = limits.lower_m, limits.upper_m
            edges = _edges(lower, upper)
            self._workspace = _add_lines(self._scene, "/workspace", edges, _BOX_RGB, width_px=1.5)
            # a corner with space for the text, on a phone too
            behind = np.array([lower[0], upper[1], upper[2]])
            self._scene.add_label(
                "/workspace/label", "workspace of the TCP", position=behind, font_screen_scale=0.8
            )
        for zone in limits.zones:
            self._add_box("zones", zone, _ZONE_RGB, 0.25)
        collision = limits.collision
        boxes = collision.obstacles if collision is not None else ()
        for box in boxes:
            self._add_box("obstacles", box, _OBSTACLE_RGB, 0.35)
        floor_m = min((float(box.lower_m[2]) for box in boxes), default=0.0)
        self._scene.add_grid(
            "/grid", 6.0, 6.0, cell_size=0.1, section_size=0.5, position=(0.0, 0.0, floor_m)
        )

    def _add_box(
        self, group: str, box: Obstacle, rgb: tuple[int, int, int], opacity: float
    ) -> None:
        handle = self._scene.add_box(
            f"/{group}/{box.name}",
            color=rgb,
            dimensions=box.upper_m - box.lower_m,
            position=(box.lower_m + box.upper_m) / 2.0,
            opacity=opacity,
            cast_shadow=False,
        )
        self._boxes[box.name] = handle, rgb, opacity


def _add_lines(
    scene: viser.SceneApi,
    name: str,
    points: NDArray[Any],
    rgb: tuple[int, int, int],
    width_px: float,
) -> viser.LineSegmentsHandle:
    """Add line segments between pairs of points [m] (n, 2, 3)."""
    return scene.add_line_segments(
        name, points=points, colors=rgb, thickness=width_px, thickness_units="screen"
    )


def _edges(lower: F64, upper: F64) -> F64:
    """The twelve edges of a box, (12, 2, 3)."""
    corners = [np.where([i & 1, i & 2, i & 4], upper, lower) for i in range(8)]
    pairs = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
    return np.array([[corners[a], corners[b]] for a, b in pairs])


def _wxyz(rotation: F64) -> F64:
    from viser.transforms import SO3  # heavy

    return np.asarray(SO3.from_matrix(rotation).wxyz, dtype=np.float64)
