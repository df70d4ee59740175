"""The robot description: the shipped URDF, and a version with meshes for rendering."""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ET
from importlib.resources import files

from rn_robot_fr3.cell import FR3, PAIR, Workcell

BASE_LINK = "fr3_link0"
FLANGE_LINK = "fr3_link8"
TCP_LINK = "fr3_hand_tcp"
PAIR_BASE_LINK = "pair_base"


@functools.cache
def urdf() -> str:
    """XML text of `data/fr3.urdf`: official kinematics and limits, shapes of cylinders and boxes,
    no mesh files.
    """
    return files("rn_robot_fr3").joinpath("data/fr3.urdf").read_text(encoding="utf-8")


def pair_urdf(cell: Workcell = PAIR) -> str:
    """XML text of the arms of a cell on one root link `PAIR_BASE_LINK`; names of links and joints
    have the arm's name as prefix.
    """
    robot = ET.Element("robot", name=cell.robot)
    inertial = ET.SubElement(ET.SubElement(robot, "link", name=PAIR_BASE_LINK), "inertial")
    ET.SubElement(inertial, "mass", value="0.001")
    moments = dict.fromkeys(("ixx", "iyy", "izz"), "1e-06")
    ET.SubElement(inertial, "inertia", {**moments, "ixy": "0", "ixz": "0", "iyz": "0"})
    for number, mount in enumerate(cell.mounts):
        arm = ET.fromstring(urdf())
        for element in arm.iter():
            for attribute in ("link", "name", "joint"):
                if element.tag != "material" and attribute in element.attrib:
                    element.set(attribute, f"{mount.prefix}{element.get(attribute)}")
        parts = list(arm)
        # materials are shared by the arms
        robot.extend([part for part in parts if part.tag != "material" or number == 0])
        joint = ET.SubElement(robot, "joint", name=f"{mount.prefix}mount", type="fixed")
        ET.SubElement(joint, "parent", link=PAIR_BASE_LINK)
        ET.SubElement(joint, "child", link=f"{mount.prefix}{BASE_LINK}")
        ET.SubElement(joint, "origin", xyz=f"{mount.x_m} 0 0", rpy=f"0 0 {mount.yaw_rad}")
    return ET.tostring(robot, encoding="unicode")


def cell_urdf(cell: Workcell) -> str:
    """XML text of the robot of a cell."""
    return urdf() if cell is FR3 else pair_urdf(cell)


_ARM_RGBA = "0.93 0.94 0.96 1"
_HAND_RGBA = "0.30 0.31 0.34 1"
_MESH_BY_LINK = {
    **{f"fr3_link{i}": (f"link{i}.obj", _ARM_RGBA) for i in range(8)},
    "fr3_hand": ("hand.obj", _HAND_RGBA),
    "fr3_leftfinger": ("finger.obj", _HAND_RGBA),
    "fr3_rightfinger": ("finger.obj", _HAND_RGBA),
}


def urdf_with_meshes(mesh_folder: str, cell: Workcell = FR3) -> str:
    """XML text of the same robot with meshes from `mesh_folder` as visual elements.

    The meshes are the Panda's from `pybullet_data`, whose links look like those of the FR3 and have
    the same frames. Kinematics, limits, inertias and collision shapes are those of `urdf`.
    """
    root = ET.fromstring(cell_urdf(cell))
    shown = {f"{mount.prefix}{name}": name for mount in cell.mounts for name in _MESH_BY_LINK}
    for link in root.iter("link"):
        if (name := shown.get(link.get("name", ""))) is None:
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
