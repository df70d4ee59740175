"""Mesh files as collision shapes: found, bounded, compared as the primitives that they show."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rn_controller_urdf.controller import UrdfController
from rn_controller_urdf.hulls import MOST_TRIANGLES, MOST_VERTICES
from roboneuron import (
    CollisionProfile,
    ConfigurationError,
    JointSample,
    Obstacle,
    RobotProfile,
)

CORNERS = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
FACES = [
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
]  # fmt: skip
"""The unit cube."""
JOINTS = ("q0", "q1", "q2", "q3")
WALL = Obstacle(name="wall", lower_m=np.array([-2.0, 0.5, -2.0]), upper_m=np.array([2.0, 0.6, 2.0]))


def write_obj(path: Path, points: list[tuple[float, ...]], faces: list[tuple[int, ...]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in points]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_stl(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    triangles = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {} {} {}\n".format(*CORNERS[i]) for i in face)
        + "endloop\nendfacet\n"
        for face in FACES
    )
    path.write_text(f"solid cube\n{triangles}endsolid cube\n", encoding="utf-8")


def arm(shape: str, folder: Path | str = "", home: tuple[float, ...] | None = None) -> RobotProfile:
    """Four bars of 0.3 m, the first standing still, that turn about y and z."""
    links = "".join(
        f'<link name="bar{i}"><collision><origin xyz="0.15 0 0"/><geometry>{shape}</geometry>'
        "</collision></link>"
        for i in range(4)
    )
    joints = "".join(
        f'<joint name="q{i}" type="continuous"><parent link="{f"bar{i - 1}" if i else "base"}"/>'
        f'<child link="bar{i}"/><origin xyz="{0.3 if i else 0} 0 0"/>'
        f'<axis xyz="{"0 1 0" if i % 2 else "0 0 1"}"/></joint>'
        for i in range(4)
    )
    tip = (
        '<link name="tcp"/><joint name="tip" type="fixed"><parent link="bar3"/>'
        '<child link="tcp"/><origin xyz="0.3 0 0"/></joint>'
    )
    return RobotProfile(
        name="bars",
        urdf=f'<robot name="bars"><link name="base"/>{links}{joints}{tip}</robot>',
        base_link="base",
        tcp_link="tcp",
        arm_joints=JOINTS,
        home_rad=None if home is None else np.array(home),
        mesh_folder=str(folder),
        collision=CollisionProfile(min_distance_m=0.01, obstacles=(WALL,)),
    )


BOX = '<box size="0.24 0.04 0.04"/>'


def mesh(name: str, scale: str = "0.24 0.04 0.04") -> str:
    return f'<mesh filename="{name}" scale="{scale}"/>'


def loaded(profile: RobotProfile) -> UrdfController:
    controller = UrdfController(None, profile)
    controller.load()
    return controller


def sample(*position: float) -> JointSample:
    return JointSample(names=JOINTS, position=np.array(position))


def told(controller: UrdfController, joints: JointSample) -> dict[tuple[str, str], float]:
    return {(pair.first, pair.second): pair.distance_m for pair in controller.distances(joints)}


@pytest.mark.parametrize("file", ["cube.stl", "cube.obj"])
@pytest.mark.parametrize("turns", [0.0, -2.0 * math.pi, 4.0 * math.pi])
def test_a_mesh_is_compared_like_the_primitive_that_it_shows(
    tmp_path: Path, file: str, turns: float
) -> None:
    write_stl(tmp_path / "cube.stl")
    write_obj(tmp_path / "cube.obj", CORNERS, FACES)
    boxes, meshes = loaded(arm(BOX)), loaded(arm(mesh(file), tmp_path))
    rng, contacts = np.random.default_rng(3), 0
    for position in rng.uniform(-math.pi, math.pi, (60, 4)):
        expected, found = told(boxes, sample(*position)), told(meshes, sample(*(position + turns)))
        assert found.keys() == expected.keys()
        for pair, distance_m in expected.items():
            assert found[pair] == pytest.approx(distance_m, abs=1e-6)
        near = {(pair.first, pair.second) for pair in meshes.inspect(sample(*position)).near or ()}
        assert near == {pair for pair, distance_m in expected.items() if distance_m < 0.01}
        contacts += len(near)
    assert contacts > 10


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("cube.obj", "cube.obj"),
        ("meshes/cube.obj", "meshes/cube.obj"),
        ("../meshes/cube.obj", "../meshes/cube.obj"),
        ("package://bars/meshes/cube.obj", "meshes/cube.obj"),  # the folder is the package
        ("package://bars/meshes/cube.obj", "bars/meshes/cube.obj"),  # the package is in it
        ("package://bars/meshes/cube.obj", "../meshes/cube.obj"),  # it is in the package
        ("package://bars/meshes/cube.obj", "../../bars/meshes/cube.obj"),  # beside it
        ("package:///bars/meshes/cube.obj", "meshes/cube.obj"),
    ],
)
def test_meshes_are_found_from_the_folder_of_the_description(
    tmp_path: Path, name: str, place: str
) -> None:
    folder = tmp_path / "src" / "bars" / "urdf"
    folder.mkdir(parents=True)
    write_obj((folder / place).resolve(), CORNERS, FACES)
    assert len(told(loaded(arm(mesh(name), folder)), sample(0, 0, 1, 0))) > 3


@pytest.mark.parametrize("scheme", ["", "file://"])
def test_absolute_paths_and_sourced_packages_need_no_folder(
    tmp_path: Path, scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_obj(tmp_path / "share" / "bars" / "cube.obj", CORNERS, FACES)
    assert loaded(arm(mesh(f"{scheme}{tmp_path}/share/bars/cube.obj")))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    assert loaded(arm(mesh("package://bars/cube.obj")))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("gone.stl", "mesh 'gone.stl' of its collision shapes has no file"),
        ("package://elsewhere/gone.dae", "'package://elsewhere/gone.dae'"),
        ("package://bars/../../etc/passwd", "has no file"),
        ("http://example.org/gone.stl", "has no file"),
        ("", "mesh '' of its"),
        ("text.stl", "cannot be read"),
    ],
)
def test_a_mesh_that_cannot_be_had_is_named(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "text.stl").write_text("no mesh", encoding="utf-8")
    with pytest.raises(ConfigurationError, match=words):
        loaded(arm(mesh(name), tmp_path))


def test_kinematics_need_no_mesh(tmp_path: Path) -> None:
    profile = replace(arm(mesh("gone.stl"), tmp_path), collision=None)
    assert loaded(profile).forward(sample(0, 0, 0, 0)).position_m == pytest.approx([1.2, 0, 0])


def test_a_hull_of_many_vertices_is_bounded_and_never_smaller(tmp_path: Path) -> None:
    """A ball of 1,500 vertices: found no farther than it is, and at most 2 mm nearer."""
    count = 1500
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    turn, width = np.arange(count) * 2.399963, np.sqrt(1.0 - height**2)
    points = 0.5 * np.stack([width * np.cos(turn), width * np.sin(turn), height], axis=1)
    faces = [(i, i + 1, i + 2) for i in range(count - 2)]
    write_obj(tmp_path / "ball.obj", [tuple(point) for point in points.tolist()], 4 * faces)
    assert count > MOST_VERTICES
    assert 4 * len(faces) > MOST_TRIANGLES  # only the hull counts
    ball = loaded(arm(mesh("ball.obj", "0.2 0.2 0.2"), tmp_path))
    true = loaded(arm('<sphere radius="0.1"/>'))
    for position in np.random.default_rng(4).uniform(-3, 3, (40, 4)):
        expected, found = told(true, sample(*position)), told(ball, sample(*position))
        for pair in expected.keys() & found.keys():
            assert -0.002 <= found[pair] - expected[pair] <= 3e-4, pair  # its facets


@pytest.mark.parametrize("segments", [200, 300, 600])
def test_a_disc_of_many_segments_is_as_near_as_a_cylinder(tmp_path: Path, segments: int) -> None:
    """A vertex of a disc's hull may have as many neighbours as there are segments."""
    turn = np.linspace(0.0, 2.0 * math.pi, segments, endpoint=False)
    rim = np.stack([0.5 * np.cos(turn), 0.5 * np.sin(turn)], axis=1)
    points = [(x, y, z) for z in (-0.5, 0.5) for x, y in rim.tolist()]
    faces = [(i, (i + 1) % segments, i + segments) for i in range(segments)]
    write_obj(tmp_path / "disc.obj", points, faces)
    disc = loaded(arm(mesh("disc.obj", "0.1 0.1 0.1"), tmp_path))
    true = loaded(arm('<cylinder radius="0.05" length="0.1"/>'))
    for position in np.random.default_rng(5).uniform(-3, 3, (40, 4)):
        expected, found = told(true, sample(*position)), told(disc, sample(*position))
        for pair in expected.keys() & found.keys():
            assert -0.002 <= found[pair] - expected[pair] <= 3e-4, pair  # its facets


def test_a_mesh_of_several_parts_is_as_near_as_one_of_one_part(tmp_path: Path) -> None:
    """Two boxes, one beside the other."""
    points = [(x / 2 + move, y, z) for move in (-0.25, 0.25) for x, y, z in CORNERS]
    faces = [(a + first, b + first, c + first) for first in (0, 8) for a, b, c in FACES]
    write_obj(tmp_path / "cube.obj", points, faces)
    lines = (tmp_path / "cube.obj").read_text(encoding="utf-8").splitlines()
    half = len(lines) - len(FACES)
    text = "\n".join(["usemtl a", *lines[:half], "usemtl b", *lines[half:], ""])
    (tmp_path / "parts.obj").write_text(text, encoding="utf-8")
    size = "0.28 0.04 0.04"
    one, parts = (loaded(arm(mesh(name, size), tmp_path)) for name in ("cube.obj", "parts.obj"))
    for position in np.random.default_rng(6).uniform(-3, 3, (200, 4)):
        expected, found = told(one, sample(*position)), told(parts, sample(*position))
        assert found == pytest.approx(expected, abs=1e-6)


ANGLE = ((0.24, 0.02, 0.02), (0.02, 0.3, 0.02)), ((0.0, 0.0, 0.0), (-0.11, 0.16, 0.0))
"""Sizes and centres of two boxes that make an angle; its hull fills the corner between them."""


def with_first(profile: RobotProfile, shapes: str) -> RobotProfile:
    """A profile with other collision shapes of its first link."""
    begin, end = '<link name="bar0">', "</link>"
    head, _, rest = profile.urdf.partition(begin)
    return replace(profile, urdf=f"{head}{begin}{shapes}{end}{rest.partition(end)[2]}")


@pytest.mark.parametrize("most_triangles", [MOST_TRIANGLES, 24, 23])
def test_surfaces_decide_where_hulls_are_too_close(
    tmp_path: Path, most_triangles: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As near as two boxes that make the same angle, unless its mesh has too many triangles."""
    monkeypatch.setattr("rn_controller_urdf.collision.MOST_TRIANGLES", most_triangles)
    points, faces, boxes = [], [], ""
    for size, centre in zip(*ANGLE, strict=True):
        faces += [tuple(i + len(points) for i in face) for face in FACES]
        points += [tuple(np.array(centre) + np.array(corner) * size) for corner in CORNERS]
        x, y, z = centre
        boxes += f'<collision><origin xyz="{x + 0.15} {y} {z}"/><geometry><box size="'
        boxes += " ".join(map(str, size)) + '"/></geometry></collision>'
    write_obj(tmp_path / "angle.obj", points, faces)
    one = '<collision><origin xyz="0.15 0 0"/><geometry>{}</geometry></collision>'
    truth = loaded(with_first(arm(BOX), boxes))
    angle = loaded(with_first(arm(BOX, tmp_path), one.format(mesh("angle.obj", "1 1 1"))))
    rng, contacts, false = np.random.default_rng(5), 0, 0
    for position in rng.uniform((-3, -0.3, 2.2, -0.3), (3, 0.3, 3.0, 0.3), (150, 4)):
        expected, found = (
            {frozenset((pair.first, pair.second)) for pair in one.inspect(sample(*position)).near}
            for one in (truth, angle)
        )
        assert expected <= found
        contacts, false = contacts + len(expected), false + len(found - expected)
    assert contacts > 10
    assert (false == 0) == (most_triangles >= len(faces))


def test_a_flat_mesh_is_compared_beside_a_hull_of_many_vertices(tmp_path: Path) -> None:
    flat = [(x, y, 0.0) for x, y, z in CORNERS if z > 0]
    write_obj(tmp_path / "flat.obj", flat, [(0, 1, 2), (1, 2, 3)])
    height = np.linspace(-0.5, 0.5, MOST_VERTICES + 200)
    turn, width = np.arange(len(height)) * 2.4, np.sqrt(0.25 - height**2)
    ball = np.stack([width * np.cos(turn), width * np.sin(turn), height], axis=1)
    faces = [(i, i + 1, i + 2) for i in range(len(ball) - 2)]
    write_obj(tmp_path / "ball.obj", [tuple(point) for point in ball.tolist()], faces)
    profile = arm(mesh("ball.obj", "0.1 0.1 0.1"), tmp_path)
    first = profile.urdf.replace("ball.obj", "flat.obj", 1)  # a plate, and balls beyond it
    found = told(loaded(replace(profile, urdf=first)), sample(0, 0, 0, 0))
    assert found["bar0", "bar2"] == pytest.approx(0.6 - 0.05 - 0.05, abs=1e-3)


def test_links_that_are_built_together_are_not_compared(tmp_path: Path) -> None:
    """Bars on either side of a wrist of 5 mm are as near as the links of one joint."""
    write_obj(tmp_path / "cube.obj", CORNERS, FACES)
    wrist = '<child link="bar2"/><origin xyz="{} 0 0"/>'
    profile = arm(mesh("cube.obj", "0.296 0.04 0.04"), tmp_path)
    assert wrist.format(0.3) in profile.urdf
    short = profile.urdf.replace(wrist.format(0.3), wrist.format(0.005))
    apart = told(loaded(replace(profile, urdf=short)), sample(0, 0, 1.0, 0))
    assert ("bar0", "bar2") not in apart
    assert {("bar0", "bar3"), ("bar1", "bar3")} <= apart.keys()
    assert ("bar0", "bar2") in told(loaded(profile), sample(0, 0, 1.0, 0))


def test_hulls_that_touch_at_home_are_not_compared(tmp_path: Path) -> None:
    write_obj(tmp_path / "cube.obj", CORNERS, FACES)
    folded = (0.0, 0.0, 3.1, 0.0)
    anywhere = told(loaded(arm(mesh("cube.obj"), tmp_path)), sample(*folded))
    assert anywhere["bar0", "bar3"] < 0.0
    turned = (0.0, 0.0, math.pi, 0.0)
    at_home = told(loaded(arm(mesh("cube.obj"), tmp_path, turned)), sample(*folded))
    assert ("bar0", "bar3") not in at_home
