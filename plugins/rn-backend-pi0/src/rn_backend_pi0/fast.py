"""The backend "pi0-fast": pi0-FAST in this process."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from rn_backend_pi0.architecture import Variant
from rn_backend_pi0.checkpoint import Pi0Checkpoint
from rn_backend_pi0.chunking import Prefix
from rn_backend_pi0.fast_tokens import load_fast_tokenizer
from rn_backend_pi0.in_process import NativeBackend
from rn_backend_pi0.options import Pi0FastOptions
from rn_vla.normalisation import Values
from roboneuron import Ahead

if TYPE_CHECKING:
    from rn_backend_pi0.model import Pi0Model
    from rn_backend_pi0.prompt import InstructionEncoder


class Pi0FastBackend(NativeBackend):
    """Decodes actions from tokens; every chunk is computed anew."""

    name: ClassVar[str] = "pi0-fast"
    variants: ClassVar[tuple[Variant, ...]] = ("pi0_fast",)

    def __init__(
        self, config: Pi0FastOptions, *, runtime: object = None, acceleration: object = None
    ) -> None:
        super().__init__(config, runtime=runtime, acceleration=acceleration)
        self._config = config

    def build_model(self, checkpoint: Pi0Checkpoint, prompt: InstructionEncoder) -> Pi0Model:
        """Load the action tokenizer and the weights.

        Raises:
            CheckpointError, ConfigurationError: see `load_fast_tokenizer` and `FastModel`.
        """
        from rn_backend_pi0.fast_model import FastModel  # heavy

        config, dims = self._config, checkpoint.dims
        actions = load_fast_tokenizer(
            checkpoint.directory,
            config.action_tokenizer,
            horizon=dims.chunk,
            width=dims.action,
            length=config.fast_length,
        )
        return FastModel(
            checkpoint,
            prompt,
            actions,
            max_outside_share=config.max_outside_share,
            device=config.device,
            dtype=config.dtype,
            numerics=config.numerics,
            resize=config.resize,
            cpu_threads=config.cpu_threads,
        )

    def reset(self) -> None:
        """Nothing to do: the backend keeps no history."""

    def draw_noise(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Zeros: decoding is greedy."""
        return np.zeros(shape, dtype=np.float32)

    def prefix_of(self, ahead: Ahead | None, state: Values) -> Prefix | None:
        """None: tokens are not guided."""
        return None
