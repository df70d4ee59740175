"""The contents of a checkpoint directory: family, dimensions, camera slots and statistics."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rn_backend_pi0.architecture import Pi0Dims
from rn_vla.normalisation import Scaling

Family = Literal["lerobot", "openpi"]
PROFILE_FILE = "roboneuron.json"
"""Optional file next to config.json that names the checkpoint's profile: {"profile": "libero"}."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FastSettings:
    """Settings of pi0-FAST's action tokens.

    Attributes:
        skip_tokens: number of ids at the end of the vocabulary that are no action tokens.
        most_tokens: longest answer.
    """

    skip_tokens: int
    most_tokens: int


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Pi0Checkpoint:
    """A described checkpoint.

    Attributes:
        directory: its folder.
        family: code that wrote it; numerics and preprocessing follow that family.
        dims: model dimensions.
        slots: names of the camera slots, in the model's order.
        state, action: statistics, with the width of the files.
        denoising_steps: Euler steps.
        action_steps: number of a chunk's actions to be executed.
        prompt_length: most tokens of a prompt.
        relative_actions: the family's own code adds the state to the first six action values.
        profile: profile named in PROFILE_FILE; empty without one.
        trained_prefix_rows: longest clean prefix that it was trained to continue, in rows; 0 for
            none.
        fast: settings of pi0-FAST; None for others.
    """

    directory: Path
    family: Family
    dims: Pi0Dims
    slots: tuple[str, ...]
    state: Scaling
    action: Scaling
    denoising_steps: int = 10
    action_steps: int = 50
    prompt_length: int = 48
    relative_actions: bool = False
    profile: str = ""
    trained_prefix_rows: int = 0
    fast: FastSettings | None = None
