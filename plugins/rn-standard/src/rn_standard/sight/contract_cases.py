"""Contract of locators, and the case of `colours`; loaded only by the contract kit and by tests.

Third parties test their locators with `contract_of(LocatorSpec)` and a `LocatorCase`, as this
package's tests do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from rn_standard.sight.cube import cube_corners
from rn_standard.sight.hooks import LocatorSpec
from rn_standard.sight.locator import CalibratedImage, LocatedObject, Locator
from rn_standard.sight.plugin import LOCATORS
from rn_standard.sight.view import CameraView
from rn_testing.case import Case
from rn_testing.effects import check_quick
from rn_testing.kinds import Kind
from rn_testing.lifecycle import Lifecycle
from rn_testing.rule import NotApplicable, Rule, require
from rn_testing.rules import OF_EVERY_DESCRIPTOR
from rn_testing.snapshots import snapshot
from roboneuron import CameraCalibration, Frame

F64 = NDArray[np.float64]

SIDE_PX = 224
TABLE_RGB = (200, 190, 175)
PAINT_RGB = {"red": (200, 25, 25), "green": (30, 150, 60), "blue": (25, 60, 210)}
Cubes = Mapping[str, tuple[float, float, float]]
"""Colour -> x [m], y [m], yaw [rad] of cubes on the table."""
_TURN_RAD, _SHIFT_M = 0.3, (0.2, -0.1, 0.0)
"""Motion of the base frame by which the rule about frames moves the cameras."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Expected:
    """An object that the pictures of a case show.

    Attributes:
        position_m: float64 (3,), its centre.
        colour: empty if the locator tells none.
        yaw_rad: direction of a face; None if the locator tells none.
    """

    position_m: F64
    colour: str = ""
    yaw_rad: float | None = None


@dataclass(frozen=True, kw_only=True)
class LocatorCase(Case[LocatorSpec]):
    """A locator to be tested.

    Attributes:
        images: calibrated pictures with objects; two of three painted cubes if None.
        expected: all objects that they show; the painted cubes for the default pictures, otherwise
            not compared if None.
        empty: pictures of the same place without objects; the painted table if None.
    """

    subject: ClassVar[str] = "locator"

    images: Sequence[CalibratedImage] | None = None
    expected: Sequence[Expected] | None = None
    empty: Sequence[CalibratedImage] | None = None

    def pictures(self) -> Sequence[CalibratedImage]:
        """The pictures with objects."""
        return _painted_cubes() if self.images is None else self.images

    def objects(self) -> Sequence[Expected]:
        """Objects on the pictures. Raises NotApplicable if the case does not say."""
        if self.images is None and self.expected is None:
            return [
                Expected(position_m=np.array([x, y, _EDGE_M / 2]), colour=colour, yaw_rad=yaw)
                for colour, (x, y, yaw) in _CUBES.items()
            ]
        if self.expected is None:
            raise NotApplicable("the case does not say what its pictures show")
        return self.expected


def _load(case: LocatorCase, locator: Locator) -> None:
    locator.load()


def _locate(case: LocatorCase, locator: Locator) -> Sequence[LocatedObject]:
    return locator.locate(case.pictures())


LIFECYCLE: Lifecycle[LocatorCase, Locator] = Lifecycle(
    subject="locator",
    protocol=Locator,
    begin="load",
    start=_load,
    uses={"locate": _locate},
)
"""Start and use of a locator."""


def _found(case: LocatorCase, *views: Sequence[CalibratedImage]) -> list[Sequence[LocatedObject]]:
    """What one locator finds in each of some groups of pictures."""
    with LIFECYCLE.running(case) as locator:
        return [locator.locate(images) for images in views]


def _told(objects: Sequence[LocatedObject]) -> list[object]:
    """The objects in an order of their own, to compare them."""
    return sorted((snapshot(one) for one in objects), key=repr)


def _check_objects(case: LocatorCase) -> None:
    expected = case.objects()
    (found,) = _found(case, case.pictures())
    left = list(found)
    for wanted in expected:
        who = f"the {wanted.colour or 'object'} at {np.round(wanted.position_m, 3).tolist()} m"
        near = [
            (float(np.linalg.norm(one.position_m - wanted.position_m)), number)
            for number, one in enumerate(left)
            if one.colour == wanted.colour
        ]
        require(bool(near), f"it did not find {who}")
        off_m, number = min(near)
        one = left.pop(number)
        require(
            off_m <= one.uncertainty_m,
            f"{who} is {off_m * 1e3:.1f} mm off, told were {one.uncertainty_m * 1e3:.1f} mm",
        )
    require(not left, f"it found {len(left)} objects that are not there: {left[:1]}")


def _check_yaw(case: LocatorCase) -> None:
    expected = [wanted for wanted in case.objects() if wanted.yaw_rad is not None]
    if not expected:
        raise NotApplicable("the case tells no yaw")
    (found,) = _found(case, case.pictures())
    for wanted in expected:
        near = [one for one in found if one.colour == wanted.colour and one.yaw_rad is not None]
        require(bool(near), f"it tells no yaw of the {wanted.colour or 'object'}")
        one = min(near, key=lambda one: float(np.linalg.norm(one.position_m - wanted.position_m)))
        period = one.symmetry_rad or 2 * np.pi
        assert one.yaw_rad is not None
        assert wanted.yaw_rad is not None
        off = (one.yaw_rad - wanted.yaw_rad + period / 2) % period - period / 2
        require(abs(off) <= 0.2, f"the yaw of {wanted.colour!r} is {off:.2f} rad off")


def _check_empty(case: LocatorCase) -> None:
    (found,) = _found(case, painted({}) if case.empty is None else case.empty)
    require(not found, f"it found {len(found)} objects in pictures without any: {found[:1]}")


def _check_blind(case: LocatorCase) -> None:
    (found,) = _found(case, ())
    require(len(found) == 0, f"it found {len(found)} objects without pictures")


def _check_form(case: LocatorCase) -> None:
    images = case.pictures()
    (found,) = _found(case, images)
    stamps = {image.frame.camera: image.frame.stamp_ns for image in images}
    for one in found:
        require(isinstance(one, LocatedObject), f"returned {one!r}, expected a LocatedObject")
        numbers = np.concatenate([one.position_m, one.size_m, [one.uncertainty_m]])
        require(one.position_m.shape == one.size_m.shape == (3,), "positions and sizes are (3,)")
        require(bool(np.isfinite(numbers).all()), f"a number of {one.label!r} is not finite")
        is_sized = one.uncertainty_m > 0 and bool((one.size_m > 0).all())
        require(is_sized, f"uncertainty or size of {one.label!r} is not positive")
        require(bool(one.label), "an object has no label")
        require(
            bool(one.cameras) and set(one.cameras) <= stamps.keys(),
            f"it names the cameras {one.cameras}, the pictures are of {', '.join(stamps)}",
        )
        oldest = min(stamps[camera] for camera in one.cameras)
        require(one.seen_at_ns == oldest, f"seen_at_ns is {one.seen_at_ns}, expected {oldest}")
        require(one.yaw_rad is None or abs(one.yaw_rad) <= np.pi + 1e-9, f"yaw {one.yaw_rad}")


def _check_repeatable(case: LocatorCase) -> None:
    images = case.pictures()
    first, again = _found(case, images, images)
    require(_told(first) == _told(again), "the same pictures gave other objects")


def _check_order(case: LocatorCase) -> None:
    images = case.pictures()
    first, turned = _found(case, images, tuple(reversed(images)))
    require(len(first) == len(turned), "the number of objects depends on the order of pictures")
    for one in first:
        off_m = min(float(np.linalg.norm(one.position_m - two.position_m)) for two in turned)
        require(off_m <= one.uncertainty_m, "a place depends on the order of the pictures")


def _check_frame(case: LocatorCase) -> None:
    c, s = np.cos(_TURN_RAD), np.sin(_TURN_RAD)
    motion = np.array(
        [[c, -s, 0, _SHIFT_M[0]], [s, c, 0, _SHIFT_M[1]], [0, 0, 1, _SHIFT_M[2]], [0, 0, 0, 1.0]]
    )
    images = case.pictures()
    moved = [replace(image, T_base_camera=motion @ image.T_base_camera) for image in images]
    here, there = _found(case, images, moved)
    require(len(here) == len(there), "with all cameras moved alike it finds other objects")
    for one in here:
        place = motion[:3, :3] @ one.position_m + motion[:3, 3]
        off_m = min(float(np.linalg.norm(place - two.position_m)) for two in there)
        require(
            off_m <= 2 * one.uncertainty_m,
            f"with all cameras moved, an object is {off_m * 1e3:.0f} mm from where it moved to",
        )


def _check_input(case: LocatorCase) -> None:
    images = case.pictures()
    before = [snapshot(image) for image in images]
    _found(case, images)
    require([snapshot(image) for image in images] == before, "it wrote into its pictures")


def _check_quick(case: LocatorCase) -> None:
    images = case.pictures()
    with LIFECYCLE.running(case) as locator:
        check_quick(case.spec.limit_s, lambda: locator.locate(images), "locate")


_OWN: tuple[Rule[LocatorCase], ...] = tuple(
    Rule(
        id=f"locator/{name}",
        text=text,
        source="rn_standard.sight.locator.Locator.locate",
        check=check,
    )
    for name, text, check in (
        ("objects-found", "Each object is found once, within its uncertainty.", _check_objects),
        ("yaw-told", "A yaw is right up to the symmetry that is told with it.", _check_yaw),
        ("nothing-invented", "Pictures without objects give none.", _check_empty),
        ("blind-finds-nothing", "Without pictures there are no objects.", _check_blind),
        (
            "objects-have-their-form",
            "Arrays are finite and (3,), sizes and uncertainty positive, cameras those of the "
            "pictures, `seen_at_ns` that of the oldest.",
            _check_form,
        ),
        ("repeatable", "The same pictures give the same objects.", _check_repeatable),
        ("order-means-nothing", "The order of the pictures changes no place.", _check_order),
        ("base-frame", "Places are in the base frame: they move with it.", _check_frame),
        ("pictures-kept", "It writes into no picture.", _check_input),
        ("locate-quick", "One answer takes at most `limit_s`.", _check_quick),
    )
)
RULES: tuple[Rule[LocatorCase], ...] = (
    *cast("tuple[Rule[LocatorCase], ...]", OF_EVERY_DESCRIPTOR),
    *LIFECYCLE.rules(),
    *_OWN,
)
"""Rules of a locator: those of every descriptor, of everything that is loaded, and its own."""
KIND = Kind(case=LocatorCase, rules=RULES)
"""Parts that the kit needs to test locators."""


def overhead_camera() -> CameraCalibration:
    """A camera 0.8 m above (0.5, 0, 0) in the base frame, looking straight down; up in the image is
    base +x.
    """
    pose = np.array(
        [[0.0, -1.0, 0.0, 0.5], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.8], [0.0, 0.0, 0.0, 1.0]]
    )
    return _camera(pose)


def side_camera() -> CameraCalibration:
    """A camera at (1.1, 0.3, 0.7) in the base frame that looks at (0.5, 0, 0)."""
    eye = np.array([1.1, 0.3, 0.7])
    ahead = np.array([0.5, 0.0, 0.0]) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.column_stack([right, np.cross(ahead, right), ahead]), eye
    return _camera(pose)


def _camera(pose: F64) -> CameraCalibration:
    intrinsics = np.array([[220.0, 0.0, SIDE_PX / 2], [0.0, 220.0, SIDE_PX / 2], [0.0, 0.0, 1.0]])
    return CameraCalibration(intrinsics=intrinsics, mount="base", T_mount_camera=pose)


def paint_cubes(
    camera: CameraCalibration, cubes: Cubes, edge_m: float = 0.044
) -> NDArray[np.uint8]:
    """An image (SIDE_PX, SIDE_PX, 3) by a fixed camera: filled outlines with slight noise."""
    noise = np.random.default_rng(0).integers(-4, 5, (SIDE_PX, SIDE_PX, 3))
    image = np.asarray(TABLE_RGB) + noise
    view = CameraView.of(camera, np.eye(4))
    rows, columns = np.mgrid[:SIDE_PX, :SIDE_PX] + 0.5
    for colour, (x_m, y_m, yaw_rad) in cubes.items():
        corners = view.project(cube_corners(np.array([x_m, y_m, yaw_rad, edge_m]), 0.0))
        image[_inside_hull(corners, columns, rows)] = PAINT_RGB[colour]
    return image.clip(0, 255).astype(np.uint8)


def _inside_hull(points: F64, columns: F64, rows: F64) -> NDArray[np.bool_]:
    """Pixels inside the convex hull of `points` (n, 2): in every direction, not beyond the
    outermost point.
    """
    inside = np.ones(columns.shape, dtype=bool)
    for angle in np.linspace(0.0, 2 * np.pi, 180, endpoint=False):
        normal = np.array([np.cos(angle), np.sin(angle)])
        inside &= columns * normal[0] + rows * normal[1] <= (points @ normal).max()
    return inside


def painted(cubes: Cubes) -> tuple[CalibratedImage, ...]:
    """Pictures of cubes on a table from above and from the side."""
    return tuple(
        CalibratedImage(
            frame=Frame(
                camera=name,
                image=paint_cubes(camera, cubes, _EDGE_M),
                stamp_ns=stamp_ns,
                frame_id=name,
                calibration=camera,
            ),
            T_base_camera=camera.T_mount_camera,
        )
        for name, camera, stamp_ns in (
            ("above", overhead_camera(), 7),
            ("side", side_camera(), 5),
        )
    )


@cache
def _painted_cubes() -> tuple[CalibratedImage, ...]:
    """The default pictures; to paint them takes longer than to find the cubes."""
    return painted(_CUBES)


_EDGE_M = 0.044
_CUBES = {"red": (0.5, 0.1, 0.3), "green": (0.42, -0.1, -0.2), "blue": (0.6, 0.0, 0.6)}


def colours_case() -> LocatorCase:
    """`colours` with three painted cubes."""
    return LocatorCase(spec=LOCATORS[0])
