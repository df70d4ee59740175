"""URDF files of the platforms: our own, made of boxes, cylinders and spheres, for every engine."""

from __future__ import annotations

from importlib.resources import files

from rn_robot_bases.platform import Platform


def urdf(platform: Platform) -> str:
    """XML text of the platform's description."""
    return (
        files("rn_robot_bases").joinpath(f"data/{platform.name}.urdf").read_text(encoding="utf-8")
    )
