"""Lines from cameras to objects: what one of them may show, and what a hand may hide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import CalibratedImage, LocatedObject
from roboneuron.sight.pointing import distance_to_box
from roboneuron.sight.rays import Ray

GOOD_M = 0.012
"""Uncertainty up to which a whole outline tells a place."""
_ARM_M, _UNDER_M = 0.13, 0.08
"""Half the width of an arm and its hand, and how far it and what it holds reach below the TCP."""
_SAMPLES = 33


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class HandSight:
    """A hand at the time of a look.

    Attributes:
        position_m: TCP (3,), base frame.
        holding: it holds something; None if that is not known.
        known: what it holds, at its present place, if pick has grasped it.
    """

    position_m: F64
    holding: bool | None = None
    known: LocatedObject | None = None

    def moved_to(self, position_m: F64) -> HandSight:
        """The hand at another place (3,)."""
        return replace(self, position_m=position_m)


def is_seen_well(one: LocatedObject) -> bool:
    """True if the place of an object is known well enough to act on."""
    return one.is_whole and one.uncertainty_m <= GOOD_M


def may_be_at(one: LocatedObject, place_m: F64, images: Sequence[CalibratedImage]) -> bool:
    """True if what was seen as an object may be one of its size with the middle at a place (3,):
    each of its cameras shows the two less than half of that size apart.
    """
    half_m = float(np.linalg.norm(one.size_m)) / 2
    shown = [image for image in images if image.frame.camera in one.cameras]
    for image in shown:
        view = image.view
        seen_px, there_px = view.project(np.stack([one.position_m, place_m]))
        far_m = float(np.linalg.norm(place_m - view.T_base_camera[:3, 3]))
        half_px = float(view.intrinsics[0, 0]) * half_m / max(far_m, half_m)
        if not float(np.linalg.norm(seen_px - there_px)) <= half_px:  # NaN: behind the camera
            return False
    return bool(shown)


def nearest_on_line(
    one: LocatedObject, place_m: F64, images: Sequence[CalibratedImage]
) -> tuple[float, F64] | None:
    """Least distance [m] of a place (3,) from the lines of sight to an object, and the point (3,)
    there; None if no line passes it before the object, or at it.
    """
    found = []
    for image in images:
        if image.frame.camera not in one.cameras:
            continue
        origin = image.T_base_camera[:3, 3]
        line = one.position_m - origin
        length_m = float(np.linalg.norm(line))
        along_m = float((place_m - origin) @ line) / max(length_m, 1e-9)
        if 0 < along_m <= length_m + one.size_m[0]:
            point = origin + along_m / length_m * line
            found.append((float(np.linalg.norm(point - place_m)), point))
    return min(found, key=lambda pair: pair[0], default=None)


def is_covered(
    place_m: F64,
    image: CalibratedImage,
    hands: Mapping[str, HandSight],
    others: Sequence[LocatedObject] = (),
) -> bool:
    """True if an arm, what its hand holds, or another object may be between a camera and a place
    (3,). An arm is taken to be above its TCP, and between that and the base.
    """
    calibration = image.frame.calibration
    origin = image.T_base_camera[:3, 3]
    line = place_m - origin
    if calibration is not None and calibration.arm is not None:
        carrier = hands.get(calibration.arm)
        if carrier is None or carrier.holding is not False:
            return True
    else:
        points = origin + np.linspace(0.0, 1.0, _SAMPLES)[:, None] * line
        if any(_is_in_arm(points, hand.position_m) for hand in hands.values()):
            return True
    length_m = float(np.linalg.norm(line))
    ray = Ray(origin=origin, direction=line / length_m)
    before = [distance_to_box(ray, other) for other in others]
    return any(far_m is not None and far_m < length_m - GOOD_M for far_m in before)


def _is_in_arm(points: F64, tcp_m: F64) -> bool:
    """True if one of the points (n, 3) is in the space that an arm may take."""
    flat_m = float(np.linalg.norm(tcp_m[:2]))
    ahead = tcp_m[:2] / max(flat_m, 1e-9)
    along = np.clip(points[:, :2] @ ahead, 0.0, flat_m)
    beside_m = np.linalg.norm(points[:, :2] - along[:, None] * ahead, axis=1)
    return bool(((beside_m < _ARM_M) & (points[:, 2] > tcp_m[2] - _UNDER_M)).any())
