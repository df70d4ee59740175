"""The backend `noop`: a policy that does nothing, as a baseline for every suite."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rn_eval.libero.plugin import MAX_ROWS
from roboneuron import ActionChunk, Observation, StateError, UngroundedError


class NoopOptions(BaseModel):
    """Options of the backend `noop`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rows: int = Field(default=8, ge=1, le=MAX_ROWS, description="actions of one prediction")
    step_s: float = Field(default=0.05, gt=0, le=1, description="time between two actions [s]")


class NoopBackend:
    """Follows `roboneuron.contract.Backend`: no motion, gripper open."""

    def __init__(
        self, config: NoopOptions | None, *, runtime: object = None, acceleration: object = None
    ) -> None:
        options = config or NoopOptions()
        self._rows = np.zeros((options.rows, 7))
        self._rows[:, 6] = 1.0
        self._step_s = options.step_s
        self._loaded = False

    def load(self) -> None:
        """Do nothing; there are no weights."""
        self._loaded = True

    def predict(self, observation: Observation) -> ActionChunk:
        """Return no motion. Raises StateError unless loaded, UngroundedError without an image, like
        a real model.
        """
        if not self._loaded:
            raise StateError("Backend 'noop' is not loaded; call load first.")
        if "primary" not in observation.frames:
            raise UngroundedError(
                "The observation has no image of role 'primary', only "
                f"{sorted(observation.frames)}."
            )
        return ActionChunk(actions=self._rows.copy(), step_s=self._step_s)

    def reset(self) -> None:
        """Do nothing; there is no state."""

    def close(self) -> None:
        """Unload."""
        self._loaded = False
