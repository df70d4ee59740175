"""Options of the runtime `torch`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

MOST_RECORDINGS = 64
"""Largest number of CUDA graphs: each holds memory, and recording one takes about as long as three
requests.
"""
WARM_LENGTHS = 29
"""Number of recorded prompt lengths, unless the options set them."""


class TorchRuntimeConfig(BaseModel):
    """Device and execution of the model."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    device: Annotated[str, Field(pattern=r"^(auto|cpu|cuda(:\d+)?)$")] = "auto"
    """`auto` selects the first CUDA device, or the CPU if there is none."""
    dtype: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    """`auto` is bfloat16 on CUDA and on processors with AMX, float32 on others."""
    decode_weights: Literal["same", "int8"] = "same"
    """`int8` additionally holds the decoder's matrices as int8 and decodes with them, on the CPU:
    half the bytes per token.
    """
    cuda_graphs: bool = True
    """Record each prompt length of `warm_prompt_tokens` once and replay it; no effect on the
    CPU.
    """
    compile: bool = False
    """Compile each decoder layer with torch.compile during load."""
    warm_prompt_tokens: tuple[int, int] | None = None
    """Prompt lengths, first and last, recorded during load on CUDA, at most 64; None: the 29
    shortest ones of the model's template. Others run unrecorded, which the status shows.
    """
    record_at_change: bool = True
    """On CUDA a changed preset records the current prompt length at once, which takes about three
    predictions.
    """
    threads: Annotated[int, Field(ge=1)] | None = None
    """CPU threads of torch in this process; None for torch's default."""

    @model_validator(mode="after")
    def _check_range(self) -> TorchRuntimeConfig:
        first, last = self.warm_prompt_tokens or (1, 1)
        if not 1 <= first <= last:
            raise ValueError(
                f"warm_prompt_tokens is ({first}, {last}), expected 1 <= first <= last"
            )
        if last - first >= MOST_RECORDINGS:
            raise ValueError(
                f"warm_prompt_tokens spans {last - first + 1} lengths, expected at most "
                f"{MOST_RECORDINGS}"
            )
        if self.decode_weights == "int8" and self.compile:
            raise ValueError('decode_weights = "int8" cannot be compiled; leave one of them out')
        return self
