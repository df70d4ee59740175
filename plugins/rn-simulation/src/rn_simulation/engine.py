"""Which physics engine simulates a robot: PyBullet or MuJoCo, whichever is installed."""

from __future__ import annotations

from typing import Literal, cast

from roboneuron import Requirement
from roboneuron.plugins import availability

Engine = Literal["pybullet", "mujoco"]
"""An engine by the name of its package."""
EngineChoice = Literal["auto", "pybullet", "mujoco"]
"""What a user may ask for."""

ENGINES: tuple[Engine, ...] = ("pybullet", "mujoco")
REQUIREMENT = Requirement(module="pybullet", alternatives=("mujoco",), install="pip install mujoco")
"""PyBullet comes first because it has been here longer; it has wheels for Python 3.11 on x86-64 only."""


def choose_engine(choice: EngineChoice) -> Engine:
    """The engine to use. Raises ConfigurationError when `choice`, or for "auto" each of them, is not installed."""
    return cast(Engine, availability.choose(REQUIREMENT, choice))
