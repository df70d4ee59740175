"""Choice of the physics engine of a simulated robot: PyBullet or MuJoCo, depending on what is
installed.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Literal, cast

from roboneuron import ConfigurationError, Requirement

Engine = Literal["pybullet", "mujoco"]
"""An engine by the name of its package."""
EngineChoice = Literal["auto", "pybullet", "mujoco"]
"""Engine as configured by a user."""

ENGINES: tuple[Engine, ...] = ("pybullet", "mujoco")
REQUIREMENT = Requirement(module="pybullet", alternatives=("mujoco",), install="pip install mujoco")
"""PyBullet is preferred as the older choice; it has wheels for Python 3.11 on x86-64 only."""


def choose_engine(choice: EngineChoice) -> Engine:
    """The engine to use: `choice`, or for "auto" the first installed one.

    Raises:
        ConfigurationError: it is not installed.
    """
    found = [
        module
        for module in (REQUIREMENT.module, *REQUIREMENT.alternatives)
        if find_spec(module) is not None
    ]
    if choice == "auto" and found:
        return cast(Engine, found[0])
    if choice in found:
        return cast(Engine, choice)
    wanted, install = "'pybullet' or 'mujoco'", REQUIREMENT.install
    if choice != "auto":
        wanted, install = f"'{choice}'", f"pip install {choice}"
    hint = f"Or leave the choice to 'auto': {' and '.join(found)} is installed." if found else ""
    raise ConfigurationError(f"Needs {wanted}, not installed; run: {install}.", hint=hint)
