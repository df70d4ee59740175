"""Collision shapes and meshes of a robot description, gathered for a package of its own."""

from __future__ import annotations

import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path

from roboneuron import ConfigurationError, mesh_file

MESHES = "meshes"
"""Folder of the copies, beside the description."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GatheredShapes:
    """What became of a description's shapes.

    Attributes:
        urdf: the description, with paths relative to its own folder.
        files: copies of meshes by path below that folder, and where they come from.
        missing: names of meshes without a file, which are left out.
        borrowed: links whose shapes for display count for collisions, for want of others.
        bare: links with a body but no shape, whose contacts nothing notices.
    """

    urdf: str
    files: dict[str, Path] = field(default_factory=dict)
    missing: tuple[str, ...] = ()
    borrowed: tuple[str, ...] = ()
    bare: tuple[str, ...] = ()

    def with_files(self) -> str:
        """The description with absolute paths of the meshes where they are now."""
        robot = ElementTree.fromstring(self.urdf)
        for mesh in robot.iter("mesh"):
            mesh.set("filename", str(self.files[mesh.get("filename", "")]))
        return ElementTree.tostring(robot, encoding="unicode")

    def copy_to(self, folder: Path) -> list[Path]:
        """Copy the meshes below `folder` and return their paths.

        Raises:
            ConfigurationError: a file cannot be copied.
        """
        written = []
        for name, source in self.files.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                shutil.copyfile(source, target)
            except OSError as error:
                raise ConfigurationError(f"The mesh {source} cannot be copied: {error}") from error
            written.append(target)
        return written


def gather_shapes(path: Path, urdf: str, package_paths: Sequence[Path]) -> GatheredShapes:
    """The shapes of a description.

    A link without collision shapes borrows those that it is displayed with.

    Args:
        path: of the description; its folder and those above are searched for meshes.
        urdf: its text.
        package_paths: further folders, which contain ROS packages or are one.
    """
    robot = ElementTree.fromstring(urdf)
    folders = [str(path.parent.resolve()), *(str(folder.resolve()) for folder in package_paths)]
    files: dict[str, Path] = {}
    missing: dict[str, None] = {}
    borrowed, bare = [], []
    for link in robot.findall("link"):
        name = link.get("name", "")
        is_body = _is_body(link)
        _settle(link, "visual", folders, files, missing)
        _settle(link, "collision", folders, files, missing)
        shown = link.findall("visual")
        if link.find("collision") is not None:
            continue
        if shown:
            link.extend([_as_collision(shape) for shape in shown])
            borrowed.append(name)
        elif is_body:
            bare.append(name)
    return GatheredShapes(
        urdf=ElementTree.tostring(robot, encoding="unicode") + "\n",
        files=files,
        missing=tuple(missing),
        borrowed=tuple(borrowed),
        bare=tuple(bare),
    )


def _settle(
    link: ElementTree.Element,
    role: str,
    folders: Sequence[str],
    files: dict[str, Path],
    missing: dict[str, None],
) -> None:
    """Name the copy of each mesh of a link; shapes without a file or without any geometry are
    removed.
    """
    for shape in link.findall(role):
        if shape.find("geometry/*") is None:
            link.remove(shape)
        for mesh in shape.iter("mesh"):
            name = mesh.get("filename", "")
            found = [mesh_file(name, folder) for folder in folders]
            source = next((file for file in found if file is not None), None)
            if source is None:
                missing[name] = None
                link.remove(shape)
                break
            mesh.set("filename", _copy_name(source.resolve(), files))


def _is_body(link: ElementTree.Element) -> bool:
    """It has a shape or a mass; frames such as a TCP have neither."""
    mass = link.find("inertial/mass")
    has_mass = mass is not None and mass.get("value", "0").strip("0.") != ""
    return has_mass or link.find("collision") is not None or link.find("visual") is not None


def _copy_name(source: Path, files: dict[str, Path]) -> str:
    """Path of the copy of a mesh, the same for the same file."""
    for name, other in files.items():
        if other == source:
            return name
    wanted = f"{MESHES}/{source.name}"
    number = 2
    while wanted in files:  # the same name in another folder, such as visual and collision
        wanted = f"{MESHES}/{source.stem}_{number}{source.suffix}"
        number += 1
    files[wanted] = source
    return wanted


def _as_collision(shape: ElementTree.Element) -> ElementTree.Element:
    collision = ElementTree.Element("collision")
    for name in ("origin", "geometry"):
        collision.extend(deepcopy(shape.findall(name)))
    return collision
