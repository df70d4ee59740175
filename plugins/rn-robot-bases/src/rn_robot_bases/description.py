"""Where the descriptions of the platforms come from: our own file, or `pybullet_data` made fit for physics."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from importlib.resources import files
from pathlib import Path

import pybullet_data

from rn_robot_bases.platform import DIFFDRIVE, Platform


def urdf(platform: Platform) -> str:
    """XML text of the platform's description; mesh files are named by absolute paths."""
    if platform is DIFFDRIVE:
        return files("rn_robot_bases").joinpath("data/diffdrive.urdf").read_text(encoding="utf-8")
    folder = Path(pybullet_data.getDataPath()) / platform.name
    root = ET.parse(folder / f"{platform.name}.urdf").getroot()
    for mesh in root.iter("mesh"):
        mesh.set("filename", str(folder / mesh.get("filename", "")))
    for link in root.findall("link"):
        if link.find("inertial") is None:
            _make_light(link)
        _round_wheel(link)
    return ET.tostring(root, encoding="unicode")


def _make_light(link: ET.Element) -> None:
    """Give a frame without a body next to no mass; PyBullet would take 1 kg and 1 kg m^2."""
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value="0.001")
    ET.SubElement(inertial, "inertia", ixx="1e-6", ixy="0", ixz="0", iyy="1e-6", iyz="0", izz="1e-6")


def _round_wheel(link: ET.Element) -> None:
    """Let a wheel touch the ground in one point below its joint, at exactly its radius.

    As a cylinder it stands on one edge or the other: skidding chatters between them, and a parked car creeps.
    """
    collision, contact = link.find("collision"), link.find("contact")
    cylinder = link.find("collision/geometry/cylinder")
    if collision is None or cylinder is None or "wheel" not in link.get("name", ""):
        return
    radius = cylinder.get("radius", "")
    collision.clear()
    ET.SubElement(ET.SubElement(collision, "geometry"), "sphere", radius=radius)
    if contact is not None:
        link.remove(contact)
