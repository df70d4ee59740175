"""Lay out ROS wheels like an installation in /opt/ros, with a `setup.bash`, and an overlay
workspace with its own types, as colcon creates it.

    python standin.py ROS WORKSPACE

Run it with the Python of the environment that has the wheels. ROS and WORKSPACE are recreated.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
from importlib.metadata import Distribution, distributions
from pathlib import Path
from types import ModuleType

SITE = Path("lib", f"python{sys.version_info.major}.{sys.version_info.minor}", "site-packages")
TYPESUPPORT = (
    Path(__file__).parents[2]
    / "plugins/rn-driver-ros2control/src/rn_driver_ros2control/interfaces/typesupport.py"
)
DEFINITIONS = {
    "msg/Seam.msg": "float64[3] offset  # [m]\nstring<=16 tool\nuint8[] picture\n",
    "srv/Strike.srv": "Seam seam\n---\nbool success\nstring message\n",
}
"""Files of the workspace's package `own_msgs`."""


def lay_out(prefix: Path, ros: Path) -> None:
    """Link the files of all ROS distributions of a virtual environment into `ros`."""
    shutil.rmtree(ros, ignore_errors=True)
    for distribution in distributions():
        name = distribution.metadata["Name"]
        if name.startswith("ros-") and name != "ros-wheels-bootstrapper":
            _link(distribution, prefix, ros)
    # an installation of ROS has all libraries in one folder
    for library in ros.glob(f"{SITE}/ros_*.libs/*.so*"):
        place = ros / "lib" / library.name
        if not place.exists():
            os.link(library, place)
    facts = {"ROS_VERSION": "2", "ROS_PYTHON_VERSION": "3", "ROS_DISTRO": ros.name}
    told = "".join(f"export {key}={value}\n" for key, value in facts.items())
    (ros / "setup.bash").write_text(_setup(ros) + told)


def _link(distribution: Distribution, prefix: Path, ros: Path) -> None:
    for file in distribution.files or ():
        source = Path(os.path.normpath(str(distribution.locate_file(file))))
        is_metadata = source.parent.suffix == ".dist-info"  # pip would treat it as its own
        if is_metadata or not source.is_relative_to(prefix) or not source.is_file():
            continue
        place = ros / source.relative_to(prefix)
        place.parent.mkdir(parents=True, exist_ok=True)
        if not place.exists():
            os.link(source, place)


def _setup(prefix: Path) -> str:
    """Values that a prefix prepends to variables, as ament's hooks do."""
    before = {
        "AMENT_PREFIX_PATH": prefix,
        "LD_LIBRARY_PATH": prefix / "lib",
        "PYTHONPATH": prefix / SITE,
        "PATH": prefix / "bin",
    }
    return "".join(f"export {k}={v}${{{k}:+:${k}}}\n" for k, v in before.items())


def make_workspace(ros: Path, workspace: Path) -> None:
    """Build `own_msgs` into `workspace/install/own_msgs`."""
    shutil.rmtree(workspace, ignore_errors=True)
    package = workspace / "src" / "own_msgs"
    for name, text in DEFINITIONS.items():
        path = package / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    install = workspace / "install"
    built = install / "own_msgs"
    _typesupport().build(package, built)
    (built / SITE).mkdir(parents=True)
    (built / "own_msgs").rename(built / SITE / "own_msgs")
    (install / "setup.bash").write_text(f". {ros}/setup.bash\n{_setup(built)}")


def _typesupport() -> ModuleType:
    spec = importlib.util.spec_from_file_location("_typesupport", TYPESUPPORT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    lay_out(Path(sys.prefix), Path(sys.argv[1]).absolute())
    make_workspace(Path(sys.argv[1]).absolute(), Path(sys.argv[2]).absolute())
