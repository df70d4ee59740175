"""The robot description: the shipped URDF, and the same one dressed in meshes for pictures."""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ET
from importlib.resources import files

BASE_LINK = "fr3_link0"
FLANGE_LINK = "fr3_link8"
TCP_LINK = "fr3_hand_tcp"


@functools.cache
def urdf() -> str:
    """XML text of `data/fr3.urdf`: official kinematics and limits, shapes of cylinders and boxes,
    no mesh files.
    """
    return files("rn_robot_fr3").joinpath("data/fr3.urdf").read_text(encoding="utf-8")


_ARM_RGBA = "0.93 0.94 0.96 1"
_HAND_RGBA = "0.30 0.31 0.34 1"
_MESH_BY_LINK = {
    **{f"fr3_link{i}": (f"link{i}.obj", _ARM_RGBA) for i in range(8)},
    "fr3_hand": ("hand.obj", _HAND_RGBA),
    "fr3_leftfinger": ("finger.obj", _HAND_RGBA),
    "fr3_rightfinger": ("finger.obj", _HAND_RGBA),
}


def urdf_with_meshes(mesh_folder: str) -> str:
    """XML text of the same robot whose visual elements are meshes in `mesh_folder`.

    The Panda's links, which `pybullet_data` carries, look like those of the FR3 and share their
    frames. Kinematics, limits, inertias and collision shapes stay those of `urdf`.
    """
    root = ET.fromstring(urdf())
    for link in root.iter("link"):
        name = link.get("name", "")
        if name not in _MESH_BY_LINK:
            continue
        for visual in link.findall("visual"):
            link.remove(visual)
        file_name, rgba = _MESH_BY_LINK[name]
        visual = ET.SubElement(link, "visual")
        if name == "fr3_rightfinger":
            ET.SubElement(visual, "origin", xyz="0 0 0", rpy="0 0 3.141592653589793")
        geometry = ET.SubElement(visual, "geometry")
        ET.SubElement(geometry, "mesh", filename=f"{mesh_folder}/{file_name}")
        material = ET.SubElement(visual, "material", name=f"{name}_colour")
        ET.SubElement(material, "color", rgba=rgba)
    return ET.tostring(root, encoding="unicode")
