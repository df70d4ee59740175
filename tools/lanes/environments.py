"""Environments for other projects: `.venv-NAME`, set up again if their contents change."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import nox

ROOT = Path(__file__).parents[2]
PYTHON_3_12 = "python3.12"


@dataclass(frozen=True)
class Environment:
    """Contents of an environment.

    Attributes:
        packages: packages from an index.
        ours: folders of this project, installed as editable.
        python: interpreter that creates it.
        constraints: constraints for the installation of dependencies.
        files: other files that it depends on.
        more: further steps after the packages.
        costs: time and space, printed before.
    """

    packages: tuple[str, ...] = ()
    ours: tuple[str, ...] = ()
    python: str = sys.executable
    constraints: Callable[[], str] = str
    files: tuple[str, ...] = ()
    more: Callable[[nox.Session, Path], None] = lambda session, folder: None
    costs: str = "ten seconds"

    def identity(self) -> str:
        """Hash of the contents."""
        read = (*self.files, *(f"{folder}/pyproject.toml" for folder in self.ours))
        parts = [*self.packages, *self.ours, self.python, self.constraints()]
        parts += [(ROOT / name).read_text(encoding="utf-8") for name in read]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _plugins(*names: str) -> tuple[str, ...]:
    return ("roboneuron-core", *(f"plugins/{name}" for name in names))


def _demo_packages() -> tuple[str, ...]:
    lines = (ROOT / "requirements.txt").read_text(encoding="utf-8").splitlines()
    return tuple(line[2:] for line in lines if line.startswith("./"))


def _all_constraints() -> str:
    return (ROOT / "constraints.txt").read_text(encoding="utf-8")


def _ros_constraints() -> str:
    """LeRobot caps numpy below 2.3, so only the constraints of the ROS packages apply."""
    lines = _all_constraints().splitlines()
    return "\n".join(line for line in lines if line.startswith("ros-"))


def _lay_out_kilted(session: nox.Session, folder: Path) -> None:
    there = (str(folder / "opt" / "ros" / "kilted"), str(folder / "workspace"))
    session.run(str(folder / "bin" / "python"), "tests/sourced/standin.py", *there)


def _replace_transformers(session: nox.Session, folder: Path) -> None:
    """Replace files of the published transformers 4.53.2 by openpi's own."""
    checkout = Path(os.environ.get("OPENPI", "../openpi"))
    theirs = checkout / "src" / "openpi" / "models_pytorch" / "transformers_replace"
    if not theirs.is_dir():
        session.error(f"OPENPI={checkout} is no checkout of openpi.")
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    place = folder / "lib" / version / "site-packages" / "transformers"
    shutil.copytree(theirs, place, dirs_exist_ok=True)


def _install_sglang(session: nox.Session, folder: Path) -> None:
    script = ROOT / "plugins" / "rn-runtime-sglang" / "interop" / "install.sh"
    session.run(str(script), str(folder), sys.executable)


_SGLANG = "plugins/rn-runtime-sglang/interop"
_CUDA = "two to four minutes, 6 GB with PyTorch for CUDA"
KILTED_PYTHON = os.environ.get("KILTED_PYTHON", PYTHON_3_12)
"""Kilted is for Python 3.12, as are its packages for Ubuntu."""
LEROBOT_PYTHON = os.environ.get("LEROBOT_PYTHON", PYTHON_3_12)
CLIENTS = {
    "mcp": ("mcp==1.30.0",),
    "fastmcp": ("fastmcp==4.2.3",),
    "langchain": ("langchain-mcp-adapters==0.3.2",),
    "strands": ("strands-agents==1.62.0",),
    "adk": ("google-adk[mcp]==2.13.0",),
    "openai": ("openai-agents==0.24.0",),
}
"""Packages whose MCP clients are tried, by the name of their script in tests/interop/clients."""
ENVIRONMENTS = {
    "fr3sim": Environment(("franka-sim==1.1.7", "numpy==1.26.4"), costs="about a minute"),
    "openai": Environment(("openai>=2",)),
    "uv": Environment(("uv>=0.9",)),
    "vla-eval": Environment(("vla-eval==0.8.0",)),
    # it imports typing_extensions without requiring it
    "openpi-client": Environment(("openpi-client==0.1.2", "typing_extensions")),
    # clients of tests/interop/clients; each has its own version of the protocol's SDK
    **{
        f"client-{name}": Environment(packages, costs="half a minute to two minutes")
        for name, packages in CLIENTS.items()
    },
    "cyclone": Environment(("cyclonedds==11.*",)),
    "kilted": Environment(
        (
            "ros-kilted-rclpy[fastrtps]",
            "ros-kilted-common-interfaces",
            "ros-kilted-test-msgs",
            "numpy",
        ),
        python=KILTED_PYTHON,
        files=("tests/sourced/standin.py",),
        more=_lay_out_kilted,
        costs="about a minute",
    ),
    # RoboNeuron as users install it, for the Python version of the sourced ROS
    "sourced": Environment(
        ours=("roboneuron-core", *_demo_packages(), "plugins/rn-interfaces"),
        python=KILTED_PYTHON,
        constraints=_all_constraints,
        costs="about two minutes",
    ),
    # a driver's own interpreter needs rn-standard, which reports the commanded gripper opening
    "lerobot": Environment(
        ("lerobot[dataset,hardware,feetech,dynamixel]==0.6.1",),
        ours=_plugins(
            *("rn-standard", "rn-simulation", "rn-robot-fr3", "rn-robot-lerobot"),
            "lerobot-robot-roboneuron",
        ),
        python=LEROBOT_PYTHON,
        costs="several gigabytes; lerobot needs Python >= 3.12",
    ),
    # an inference module needs the robot, the controller's descriptor and the standard features
    "lerobot-policies": Environment(
        (
            *("lerobot[dataset,diffusion,smolvla,pi]==0.6.1", "hypothesis"),
            *("pytest", "pytest-timeout", "pytest-xdist"),
        ),
        ours=_plugins(
            *("rn-standard", "rn-simulation", "rn-robot-fr3", "rn-controller-urdf", "rn-vla"),
            *("rn-runtime-torch", "rn-backend-openpi", "rn-eval", "rn-testing"),
            "rn-backend-lerobot",
        ),
        python=LEROBOT_PYTHON,
        constraints=_ros_constraints,
        costs="several gigabytes; LeRobot needs Python >= 3.12",
    ),
    # all that docs/so101.md needs: the server, LeRobot's arms, cameras and policies
    "so101": Environment(
        ("lerobot[dataset,hardware,feetech,diffusion,smolvla,pi]==0.6.1", "scipy", "tomlkit"),
        ours=(
            *_demo_packages(),
            *("plugins/rn-robot-lerobot", "plugins/rn-perception-camera", "plugins/rn-vla"),
            *("plugins/rn-backend-lerobot", "plugins/lerobot-robot-roboneuron"),
        ),
        python=LEROBOT_PYTHON,
        constraints=_ros_constraints,
        costs="several gigabytes; LeRobot needs Python >= 3.12",
    ),
    # its reference stack is for Python 3.10 and 3.11 only
    "libero": Environment(
        ("--requirement", "plugins/rn-eval/simulator-requirements.txt"),
        python=os.environ.get("LIBERO_PYTHON", "python3.11"),
        files=("plugins/rn-eval/simulator-requirements.txt",),
        costs="about five minutes, 2.1 GB",
    ),
    "openpi": Environment(
        (
            *("torch", "transformers==4.53.2", "numpy"),
            *("safetensors", "sentencepiece", "einops"),
        ),
        more=_replace_transformers,
        costs=_CUDA,
    ),
    # requirements of lerobot; of lerobot itself only the files of pi0-FAST are loaded
    "fast": Environment(
        ("torch", "transformers==5.5.4", "numpy", "safetensors", "scipy", "draccus"), costs=_CUDA
    ),
    "sglang": Environment(
        files=(f"{_SGLANG}/install.sh", f"{_SGLANG}/requirements.txt"),
        more=_install_sglang,
        costs="about five minutes",
    ),
}
"""Environment by name."""


def folder_of(name: str) -> Path:
    """Folder of an environment."""
    return ROOT / f".venv-{name}"


def python_of(name: str) -> Path:
    """Interpreter of an environment."""
    return folder_of(name) / "bin" / "python"


def prepare(session: nox.Session, name: str) -> None:
    """Set up an environment, unless it is there and unchanged.

    A session fails if there is no such environment, or its Python is missing.
    """
    if name not in ENVIRONMENTS:
        session.error(f"There is no environment {name!r}: {', '.join(ENVIRONMENTS)}")
    wanted, folder = ENVIRONMENTS[name], folder_of(name)
    ready = folder / ".ready"
    identity = wanted.identity()
    if ready.exists() and ready.read_text(encoding="utf-8") == identity:
        return
    session.log(f"Setting up {folder.name} (once, {wanted.costs}) ...")
    ready.unlink(missing_ok=True)
    if shutil.which(wanted.python) is None:
        session.error(f"{folder.name} needs {wanted.python}, which is not installed.")
    if not python_of(name).exists():
        session.run(wanted.python, "-m", "venv", str(folder))
    if wanted.packages or wanted.ours:
        limits = folder / "constraints.txt"
        limits.write_text(wanted.constraints(), encoding="utf-8")
        editable = [word for path in wanted.ours for word in ("--editable", path)]
        session.run(
            *(str(python_of(name)), "-m", "pip", "install", "--quiet"),
            *("--disable-pip-version-check", "--constraint", str(limits)),
            *wanted.packages,
            *editable,
        )
    wanted.more(session, folder)
    ready.write_text(identity, encoding="utf-8")
