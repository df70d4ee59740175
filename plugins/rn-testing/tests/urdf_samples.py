"""Small robot descriptions made by the tests: each differs from `ARM` in one thing."""

from __future__ import annotations

import struct
from pathlib import Path

LIMIT = '<limit lower="-2" upper="2" velocity="1.5" effort="30"/>'
SLIDE = '<limit lower="0" upper="0.04" velocity="0.1" effort="20"/>'
BALL = '<sphere radius="0.04"/>'


def link(name: str, shape: str = BALL, role: str = "collision") -> str:
    """A link with one shape; without one for an empty `shape`."""
    body = f"<{role}><geometry>{shape}</geometry></{role}>" if shape else ""
    return f'<link name="{name}">{body}</link>'


def joint(
    name: str,
    parent: str,
    child: str,
    kind: str = "revolute",
    *,
    more: str = LIMIT,
    axis: str = "0 1 0",
    xyz: str = "0 0 0.25",
) -> str:
    """A joint; `more` is what stands in it besides links, origin and axis."""
    inside = "" if kind == "fixed" else f'<axis xyz="{axis}"/>{more}'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/>{inside}</joint>'
    )


def robot(*parts: str) -> str:
    """A description of these elements."""
    return f'<robot name="sample">{"".join(parts)}</robot>'


ARM = (
    link("base_link"),
    link("l1"),
    link("l2"),
    link("l3"),
    link("tcp", ""),
    joint("j1", "base_link", "l1", axis="0 0 1"),
    joint("j2", "l1", "l2"),
    joint("j3", "l2", "l3"),
    joint("mount", "l3", "tcp", "fixed", xyz="0 0 0.1"),
)
"""Elements of an arm of three joints on a base, without a gripper."""
FINGERS = (
    link("left"),
    link("right"),
    joint("slide", "l3", "left", "prismatic", more=SLIDE, xyz="0 0.01 0.1"),
    joint(
        "other",
        "l3",
        "right",
        "prismatic",
        more=f'{SLIDE}<mimic joint="slide"/>',
        axis="0 -1 0",
        xyz="0 -0.01 0.1",
    ),
)
"""Two fingers for `ARM`, of which one follows the other."""


def write(folder: Path, *parts: str) -> Path:
    """Write a description of these elements."""
    path = folder / "sample.urdf"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(robot(*parts), encoding="utf-8")
    return path


def write_box_mesh(path: Path, half_m: float = 0.03) -> None:
    """Write a cube as a binary STL file of twelve triangles."""
    corners = [
        (x, y, z) for x in (-half_m, half_m) for y in (-half_m, half_m) for z in (-half_m, half_m)
    ]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = [(q[0], q[i], q[i + 1]) for q in quads for i in (1, 2)]
    data = bytes(80) + struct.pack("<I", len(triangles))
    for triangle in triangles:
        points = [value for index in triangle for value in corners[index]]
        data += struct.pack("<12fH", 0.0, 0.0, 0.0, *points, 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
