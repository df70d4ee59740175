"""The sentence on distances that are not checked, by its cause."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from roboneuron.config import LimitsConfig
from roboneuron.contract import CollisionProfile, RobotProfile
from roboneuron.gate.motion import collision_of

SHAPE = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
MESH = '<collision><geometry><mesh filename="package://arm/a.stl"/></geometry></collision>'
VISUAL = '<visual><geometry><mesh filename="gone.dae"/></geometry></visual>'
WALL = {"name": "wall", "lower_m": [0, 0, 0], "upper_m": [1, 1, 1]}
ASKED = {"min_distance_m": 0.02}


def arm(inside: str, *, asks: bool = False, folder: Path | str = "") -> RobotProfile:
    return RobotProfile(
        name="arm",
        urdf=f'<robot name="arm"><link name="base">{VISUAL}{inside}</link></robot>',
        arm_joints=("j1",),
        collision=CollisionProfile() if asks else None,
        mesh_folder=str(folder),
    )


@pytest.mark.parametrize(
    ("profile", "limits", "why", "how"),
    [
        (arm(SHAPE), {}, "neither its profile nor", "Set min_distance_m = 0.01 in [limits]."),
        (arm(""), {}, "no collision shapes", "and set min_distance_m = 0.01 in [limits]."),
        (arm("", asks=True), {}, "no collision shapes", "to its links."),
        (arm(SHAPE, asks=True), {"collision": False}, "limits.collision is false", "to true."),
        (arm(SHAPE), {"collision": False}, "limits.collision is false", "and set min_distance_m"),
        (arm(MESH), {}, "mesh 'package://arm/a.stl' has no file", "and set min_distance_m"),
        (arm(MESH), ASKED, "mesh 'package://arm/a.stl' has no file", "Set mesh_folder"),
        (arm("<collision/>"), ASKED, "no collision shapes", "Add boxes"),
        (replace(arm(SHAPE), urdf="no xml"), ASKED, "no collision shapes", "Add boxes"),
    ],
)
def test_the_cause_and_what_to_do_are_told(
    profile: RobotProfile, limits: dict[str, object], why: str, how: str
) -> None:
    told = profile.why_unchecked(LimitsConfig.model_validate(limits))
    assert told.startswith("Distances between the links of 'arm'")
    assert why in told
    assert how in told


@pytest.mark.parametrize(
    ("profile", "limits"),
    [
        (arm(SHAPE, asks=True), {}),
        (arm(SHAPE), ASKED),
        (arm(SHAPE), {"min_distance_m": 0.0}),
        (arm(SHAPE), {"obstacles": [WALL]}),
        (arm(SHAPE), {"obstacles": []}),
        (replace(arm(""), arm_joints=()), {}),
    ],
)
def test_nothing_is_told_of_an_arm_that_is_checked_or_of_a_base(
    profile: RobotProfile, limits: dict[str, object]
) -> None:
    config = LimitsConfig.model_validate(limits)
    assert profile.why_unchecked(config) == ""
    assert (collision_of(config, profile) is not None) is bool(profile.arm_joints)


def test_a_mesh_that_is_found_is_checked(tmp_path: Path) -> None:
    (tmp_path / "arm").mkdir()
    (tmp_path / "arm" / "a.stl").write_text("solid\nendsolid\n", encoding="utf-8")
    assert arm(MESH, asks=True, folder=tmp_path).why_unchecked(LimitsConfig()) == ""


def test_a_controller_without_distances_is_told() -> None:
    told = arm(SHAPE, asks=True).why_unchecked(LimitsConfig(), are_told=False)
    assert "the controller tells none" in told


def test_places_without_a_controller_come_before_distances() -> None:
    told = arm("").why_unchecked(LimitsConfig(), places="no controller. Install one.")
    assert told.startswith("Places and distances on the way of joint commands to 'arm'")
    assert told.endswith("no controller. Install one.")
