"""Rules of locators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rn_testing.effects import check_quick
from rn_testing.fakes.painted_table import painted
from rn_testing.lifecycle import Lifecycle
from rn_testing.locator_case import LocatorCase
from rn_testing.rule import NotApplicable, Rule, require
from rn_testing.snapshots import snapshot
from roboneuron import (
    CalibratedImage,
    LocatedObject,
    Locator,
)

F64 = NDArray[np.float64]
_TURN_RAD = 0.3
_MOTION = np.array(
    [
        [np.cos(_TURN_RAD), -np.sin(_TURN_RAD), 0.0, 0.2],
        [np.sin(_TURN_RAD), np.cos(_TURN_RAD), 0.0, -0.1],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Motion of the base frame by which rules move the cameras."""


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
            if one.colour in ("", wanted.colour)
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
        near = [
            one for one in found if one.colour in ("", wanted.colour) and one.yaw_rad is not None
        ]
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
    images = case.pictures()
    moved = [replace(image, T_base_camera=_MOTION @ image.T_base_camera) for image in images]
    here, there = _found(case, images, moved)
    require(len(here) == len(there), "with all cameras moved alike it finds other objects")
    for one in here:
        place = _MOTION[:3, :3] @ one.position_m + _MOTION[:3, 3]
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


def _check_layout(case: LocatorCase) -> None:
    """The same pictures, each as a part of a larger array."""
    images = case.pictures()
    strided = [
        replace(one, frame=replace(one.frame, image=np.repeat(one.frame.image, 2, axis=1)[:, ::2]))
        for one in images
    ]
    here, there = _found(case, images, strided)
    require(_told(here) == _told(there), "pictures that are not contiguous gave other objects")


def _check_kept(case: LocatorCase) -> None:
    with LIFECYCLE.running(case) as locator:
        found = locator.locate(case.pictures())
        before = snapshot(found)
        moved = [replace(one, T_base_camera=_MOTION @ one.T_base_camera) for one in case.pictures()]
        locator.locate(moved)
    require(snapshot(found) == before, "found objects change with the next pictures")


def _check_quick(case: LocatorCase) -> None:
    images = case.pictures()
    with LIFECYCLE.running(case) as locator:
        check_quick(case.spec.limit_s, lambda: locator.locate(images), "locate")


_OWN = tuple(
    Rule(
        id=f"locator/{name}",
        text=text,
        source="roboneuron.Locator.locate",
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
        ("any-layout", "The memory layout of a picture means nothing.", _check_layout),
        ("answers-kept", "Returned objects are not changed later.", _check_kept),
        ("locate-quick", "One answer takes at most `limit_s`.", _check_quick),
    )
)
RULES: tuple[Rule[LocatorCase], ...] = (*LIFECYCLE.rules(), *_OWN)
"""Rules of everything that is loaded, and those of locators."""
