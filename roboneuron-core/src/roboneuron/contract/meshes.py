"""Files of the meshes that a robot description names.

Source of `package://` and of the index of packages: the URDF specification and ament's
`share/<package>` below each prefix of AMENT_PREFIX_PATH.
"""

from __future__ import annotations

import functools
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path


@functools.lru_cache(maxsize=16)
def collision_meshes(urdf: str) -> tuple[str, ...]:
    """Names of the meshes among the collision shapes, each once; empty for an invalid URDF."""
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError:
        return ()
    meshes = (mesh for shape in root.iter("collision") for mesh in shape.iter("mesh"))
    return tuple(dict.fromkeys(mesh.get("filename", "") for mesh in meshes))


@functools.lru_cache(maxsize=16)
def has_collision_shapes(urdf: str) -> bool:
    """Whether a link of a URDF has a collision shape."""
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError:
        return False
    return any(len(shape) for shape in root.iterfind("link/collision/geometry"))


def mesh_file(name: str, folder: str) -> Path | None:
    """The file of a mesh; None if there is none.

    Args:
        name: as in the description: `package://`, `file://`, absolute, or relative to `folder`.
        folder: of the description; packages are also looked for in it and in the folders above.
    """
    return next((path for path in _candidates(name, folder) if path.is_file()), None)


def _candidates(name: str, folder: str) -> Iterator[Path]:
    scheme, separator, rest = name.partition("://")
    if not separator or scheme == "file":
        path = Path(rest if separator else name)
        if path.is_absolute():
            yield path
        elif folder and name:
            yield Path(folder) / path
        return
    if scheme != "package":
        return
    package, _, inside = rest.lstrip("/").partition("/")
    if not inside or ".." in Path(inside).parts:
        return
    if folder:
        home = Path(folder).resolve()
        for place in (home, *home.parents):
            yield place / package / inside
            if place.name == package:
                yield place / inside
        yield home / inside
    for prefix in _split("AMENT_PREFIX_PATH"):
        yield Path(prefix) / "share" / package / inside
    for prefix in _split("ROS_PACKAGE_PATH"):
        yield Path(prefix) / package / inside


def _split(variable: str) -> list[str]:
    return [part for part in os.environ.get(variable, "").split(os.pathsep) if part]
