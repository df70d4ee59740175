"""Places of objects that a detector has boxed in pictures: by depth, a second view, or the table's
plane.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import CalibratedImage, LocatedObject
from roboneuron.sight.depth import DepthOptions, SurfaceBox, surface_boxes, told_box
from roboneuron.sight.rays import MEET_M, Ray, grouped, ray_through

_SAME_BOX, _SAME_SURFACE = 0.6, 0.3
"""Overlap of two boxes of one object in a picture, and of a box and the surface that it shows, as a
part of their union.
"""
_MOST_RATIO = 2.0
"""Largest ratio of the sizes that two views of one object tell."""
_BOX_PX = 2.0
"""Error of a box's middle, at least."""
_TWO_VIEWS, _ON_TABLE, _ON_SURFACE = 0.12, 0.5, 0.6
"""Uncertainty in sizes of the object: the middle of its box is not its centre; and its height is
assumed to be its width.
"""
_MOST_SIZE_M = 1.0
"""Larger things are no objects on a table."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ImageDetection:
    """An object in one picture.

    Attributes:
        image: the picture.
        label: what it is.
        score: the larger the surer, 0..1.
        box_px: float64 (4,), left, upper, right and lower edge [px]; without extent, a point on it.
    """

    image: CalibratedImage
    label: str
    score: float
    box_px: F64

    @property
    def centre_px(self) -> F64:
        """Middle (2,)."""
        return (self.box_px[:2] + self.box_px[2:]) / 2

    @property
    def size_px(self) -> F64:
        """Width and height (2,)."""
        size: F64 = self.box_px[2:] - self.box_px[:2]
        return size

    @property
    def is_cut(self) -> bool:
        """It touches the edge of the picture."""
        height, width = self.image.frame.image.shape[:2]
        low, high = self.box_px[:2], self.box_px[2:]
        return bool(low.min() < 1 or high[0] > width - 1 or high[1] > height - 1)

    @property
    def ray(self) -> Ray:
        """Line of sight of its middle."""
        return ray_through(self.image.view, self.centre_px)

    def size_at(self, place_m: F64) -> F64:
        """Width and height (2,) of its box at a place (3,) [m]."""
        view = self.image.view
        along_m = float((place_m - view.T_base_camera[:3, 3]) @ view.T_base_camera[:3, 2])
        focal_px = np.array([view.intrinsics[0, 0], view.intrinsics[1, 1]])
        size_m: F64 = self.size_px * along_m / focal_px
        return size_m


def place_detections(
    detections: Iterable[ImageDetection], *, usual_m: float
) -> list[LocatedObject]:
    """Objects at the places of detections, each once; what cannot be placed is left out.

    Boxes are cut at the edge of their picture; what is outside is left out.

    A box that shows a surface of a depth image is that object; otherwise those of one label whose
    lines of sight meet are one; otherwise it stands on the table, as high as it is wide.

    Args:
        detections: of all pictures, in any order.
        usual_m: size of what is pointed at without a box.
    """
    kept = _once(one for found in detections if (one := _inside(found)) is not None)
    placed = []
    surfaces = _surfaces(kept, DepthOptions())
    for group in grouped(kept, lambda one, other: _apart_m(one, other, surfaces)):
        shown = [surfaces[id(one)] for one in group if id(one) in surfaces]
        if shown:
            shown.sort(key=lambda box: (not box.is_whole, box.uncertainty_m))
            placed.append(_seen_by(group, told_box(shown, group[0].label)))
            continue
        found = _by_two_views(group, usual_m)
        if found is None:
            found = _by_depth(group[0], usual_m) or _on_table(group[0], usual_m)
        if found is not None and found.size_m.max() <= _MOST_SIZE_M:
            placed.append(found)
    return placed


def _inside(found: ImageDetection) -> ImageDetection | None:
    """A detection cut at the edge of its picture; None if less than a pixel is left, or the point
    is outside.
    """
    height, width = found.image.frame.image.shape[:2]
    inside = np.clip(found.box_px, 0.0, [width, height, width, height])
    if (found.size_px == 0).all():
        return found if (inside == found.box_px).all() else None
    return replace(found, box_px=inside) if (inside[2:] - inside[:2] >= 1.0).all() else None


def _overlap(one: F64, other: F64) -> float:
    """Intersection of two boxes (4,) as a part of their union."""
    inner = np.minimum(one[2:], other[2:]) - np.maximum(one[:2], other[:2])
    if (inner <= 0).any():
        return 0.0
    both = float(inner.prod())
    areas = [float((box[2:] - box[:2]).prod()) for box in (one, other)]
    return both / (areas[0] + areas[1] - both)


def _once(detections: Iterable[ImageDetection]) -> list[ImageDetection]:
    """The surest first, without others of one label at the same place of a picture."""
    ordered = sorted(
        detections, key=lambda one: (-one.score, one.image.frame.camera, one.box_px.tolist())
    )
    kept: list[ImageDetection] = []
    for one in ordered:
        same = (
            _overlap(one.box_px, other.box_px) > _SAME_BOX or _is_inside(one.box_px, other.box_px)
            for other in kept
            if other.image is one.image and other.label == one.label
        )
        if not any(same):
            kept.append(one)
    return kept


def _is_inside(point: F64, box: F64) -> bool:
    """True for a box without extent (4,) in another one, or where that one is a point in it."""
    if (point[:2] == point[2:]).all():
        return bool((box[:2] <= point[:2]).all() and (point[:2] <= box[2:]).all())
    return bool((box[:2] == box[2:]).all()) and _is_inside(box, point)


def _surfaces(detections: Sequence[ImageDetection], options: DepthOptions) -> dict[int, SurfaceBox]:
    """The surface that each detection shows, by the detection's identity."""
    found: dict[int, SurfaceBox] = {}
    for image in {id(one.image): one.image for one in detections}.values():
        boxes = list(surface_boxes(image, options))
        fitting = sorted(
            (
                (1.0 if _is_inside(one.box_px, box.box_px) else overlap, number, one)
                for one in detections
                if one.image is image
                for number, box in enumerate(boxes)
                if (overlap := _overlap(one.box_px, box.box_px)) >= _SAME_SURFACE
                or _is_inside(one.box_px, box.box_px)
            ),
            key=lambda pair: -pair[0],
        )
        for _, number, one in fitting:
            found.setdefault(id(one), boxes[number])
    return found


def _apart_m(one: ImageDetection, other: ImageDetection, surfaces: dict[int, SurfaceBox]) -> float:
    """Distance of two detections in different pictures; infinite if they cannot be one object."""
    if one.label != other.label:
        return np.inf
    here, there = surfaces.get(id(one)), surfaces.get(id(other))
    if here is not None and there is not None:
        return float(np.linalg.norm(here.centre_m - there.centre_m))
    meeting = one.ray.meeting(other.ray)
    if meeting is None:
        return np.inf
    place, apart_m = meeting
    for surface in (here, there):
        if surface is not None and np.linalg.norm(place - surface.centre_m) > 2 * MEET_M:
            return np.inf
    sizes = [float(seen.size_at(place).max()) for seen in (one, other)]
    is_like = min(sizes) <= 0.0 or max(sizes) <= _MOST_RATIO * min(sizes)
    return apart_m if is_like else np.inf


def _by_two_views(group: Sequence[ImageDetection], usual_m: float) -> LocatedObject | None:
    if len(group) < 2:
        return None
    meeting = group[0].ray.meeting(group[1].ray)
    if meeting is None:
        return None
    place, apart_m = meeting
    sizes = np.stack([_size(seen, place, usual_m) for seen in group[:2]])
    size = sizes.mean(axis=0)
    error_m = max(_pixel_m(seen, place) for seen in group[:2])
    return _object(
        group, place, size, _TWO_VIEWS * float(size.max()) + error_m + apart_m, is_assumed=False
    )


def _by_depth(seen: ImageDetection, usual_m: float) -> LocatedObject | None:
    """By the surface in the middle of its box, which is nearer than its centre."""
    depth_m = seen.image.frame.depth_m
    if depth_m is None:
        return None
    column, row = seen.centre_px.astype(int)
    half = np.maximum(seen.size_px // 4, 1).astype(int)
    patch = depth_m[
        max(0, row - half[1]) : row + half[1] + 1, max(0, column - half[0]) : column + half[0] + 1
    ]
    known = patch[np.isfinite(patch) & (patch > 0)]
    if not known.size:
        return None
    ray = seen.ray
    forward = float(ray.direction @ seen.image.T_base_camera[:3, 2])
    surface = ray.origin + float(np.median(known)) / forward * ray.direction
    size = _size(seen, surface, usual_m)
    place = surface + ray.direction * float(size.min()) / 2
    error_m = _ON_SURFACE * float(size.max()) + _pixel_m(seen, place)
    return _object([seen], place, size, error_m, is_assumed=False)


def _on_table(seen: ImageDetection, usual_m: float) -> LocatedObject | None:
    ray = seen.ray
    place = ray.at_height(seen.image.table_m)
    if place is None or place[2] >= ray.origin[2]:
        return None
    height_m = float(_size(seen, place, usual_m)[2])
    place = ray.at_height(seen.image.table_m + height_m / 2)
    if place is None:
        return None
    size = _size(seen, place, usual_m)
    slope = max(0.05, abs(float(ray.direction[2])))
    error_m = (_ON_TABLE * float(size.max()) / 2 + _pixel_m(seen, place)) / slope
    return _object([seen], place, size, error_m, is_assumed=True)


def _size(seen: ImageDetection, place_m: F64, usual_m: float) -> F64:
    """Size (3,) of what is in a box, if it is as deep as wide and no higher than that or the box
    shows; `usual_m` in all directions for a point.
    """
    width_m, height_m = seen.size_at(place_m).tolist()
    if width_m <= 0 or height_m <= 0:
        return np.full(3, usual_m)
    return np.array([width_m, width_m, min(width_m, height_m)])


def _pixel_m(seen: ImageDetection, place_m: F64) -> float:
    """Width of the error of a box at a place (3,) [m]."""
    view = seen.image.view
    along_m = float(np.linalg.norm(place_m - view.T_base_camera[:3, 3]))
    return _BOX_PX * along_m / float(view.intrinsics[0, 0])


def _object(
    group: Sequence[ImageDetection],
    place_m: F64,
    size_m: F64,
    uncertainty_m: float,
    *,
    is_assumed: bool,
) -> LocatedObject:
    frames = [seen.image.frame for seen in group]
    return LocatedObject(
        label=group[0].label,
        position_m=place_m,
        size_m=size_m,
        uncertainty_m=uncertainty_m,
        cameras=tuple(frame.camera for frame in frames),
        seen_at_ns=min(frame.stamp_ns for frame in frames),
        is_whole=not any(seen.is_cut for seen in group),
        is_height_assumed=is_assumed,
    )


def _seen_by(group: Sequence[ImageDetection], found: LocatedObject) -> LocatedObject:
    """The object, with all cameras that saw it."""
    frames = [seen.image.frame for seen in group]
    return replace(
        found,
        cameras=tuple(frame.camera for frame in frames),
        seen_at_ns=min(frame.stamp_ns for frame in frames),
    )
