"""Which physics engine simulates the FR3: PyBullet or MuJoCo, whichever is installed."""

from __future__ import annotations

from typing import Literal

from roboneuron.errors import ConfigurationError
from roboneuron.plugins.availability import is_importable
from roboneuron.plugins.specs import Requirement

Engine = Literal["pybullet", "mujoco"]
"""An engine by the name of its package."""
EngineChoice = Literal["auto", "pybullet", "mujoco"]
"""What a user may ask for."""

ENGINES: tuple[Engine, ...] = ("pybullet", "mujoco")
"""In the order in which "auto" looks for them."""
REQUIREMENT = Requirement(module="pybullet", alternatives=("mujoco",), install="pip install mujoco")


def choose_engine(choice: EngineChoice) -> Engine:
    """The engine to use: `choice`, or for "auto" the first of `ENGINES` that is installed.

    Raises:
        ConfigurationError: it is not installed.
    """
    wanted = ENGINES if choice == "auto" else (choice,)
    for engine in wanted:
        if is_importable(engine):
            return engine
    names = "neither pybullet nor mujoco is" if choice == "auto" else f"{choice} is not"
    raise ConfigurationError(
        f"The FR3 cannot be simulated: {names} installed.",
        hint="pip install mujoco. PyBullet has wheels for Python 3.11 on x86-64 only.",
    )
