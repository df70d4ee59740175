"""The backend "pi0": pi0 and pi0.5 in this process."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from rn_backend_pi0.architecture import Variant
from rn_backend_pi0.checkpoint import Pi0Checkpoint
from rn_backend_pi0.chunking import Prefix, RunningChunk
from rn_backend_pi0.in_process import NativeBackend
from rn_backend_pi0.options import Pi0Options
from rn_vla.normalisation import Values
from roboneuron import Ahead

if TYPE_CHECKING:
    from rn_backend_pi0.model import Pi0Model
    from rn_backend_pi0.prompt import InstructionEncoder


class Pi0Backend(NativeBackend):
    """Integrates a flow from noise to actions, optionally continuing the rows that are being
    executed.
    """

    name: ClassVar[str] = "pi0"
    variants: ClassVar[tuple[Variant, ...]] = ("pi0", "pi05")

    def __init__(
        self, config: Pi0Options, *, runtime: object = None, acceleration: object = None
    ) -> None:
        super().__init__(config, runtime=runtime, acceleration=acceleration)
        self._config = config
        self._random = np.random.default_rng(config.numpy_seed)

    def prompt_like(self, variant: Variant) -> Variant:
        """That of pi0, without the state, if the option `state_in_prompt` is false."""
        return variant if self._config.state_in_prompt else "pi0"

    def build_model(self, checkpoint: Pi0Checkpoint, prompt: InstructionEncoder) -> Pi0Model:
        """Read the weights. Raises CheckpointError, ConfigurationError: see `Pi0Model`."""
        from rn_backend_pi0.model import Pi0Model  # heavy

        config = self._config
        return Pi0Model(
            checkpoint,
            device=config.device,
            dtype=config.dtype,
            numerics=config.numerics,
            resize=config.resize,
            steps=config.denoising_steps,
            cpu_threads=config.cpu_threads,
        )

    def reset(self) -> None:
        """Restart the noise, so that an episode with a seed is repeatable."""
        self._random = np.random.default_rng(self._config.numpy_seed)

    def prefix_of(self, ahead: Ahead | None, state: Values) -> Prefix | None:
        """The rest of the running chunk in the model's own form; None if there is none to
        continue.
        """
        config, model, conversion = self._config, self._model, self._conversion
        running = None if ahead is None else ahead.context
        if (
            not config.rtc
            or ahead is None
            or not isinstance(running, RunningChunk)
            or model is None
            or conversion is None
        ):
            return None
        rows = running.normalized[ahead.context_row :]
        if not len(rows):
            return None
        at = conversion.relative
        if len(at):  # the rows are relative to the old state
            rows = rows.copy()
            rows[:, at] += (running.state - state)[at] / model.action.unit(conversion.precision)[at]
        trained = model.checkpoint.trained_prefix_rows
        return Prefix(
            rows=rows,
            committed=min(ahead.committed_rows, trained) if trained else ahead.committed_rows,
            horizon=config.rtc_horizon,
            schedule=config.rtc_schedule,
            max_weight=config.rtc_max_weight,
            jacobian=config.rtc_jacobian,
            trained=trained > 0,
        )

    def draw_noise(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        random = (
            np.random.default_rng(self._config.numpy_seed)
            if self._config.noise == "fixed"
            else self._random
        )
        return random.standard_normal(shape, dtype=np.float32)
