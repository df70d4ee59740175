"""Options of the runtime `torch`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator


class TorchRuntimeConfig(BaseModel):
    """Where and how the model is executed."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    device: Annotated[str, Field(pattern=r"^(auto|cpu|cuda(:\d+)?)$")] = "auto"
    """`auto` takes the first CUDA device, or the CPU when there is none."""
    dtype: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    """`auto` is bfloat16 on CUDA and float32 on the CPU."""
    cuda_graphs: bool = True
    """Capture each request shape once and replay it; without effect on the CPU."""
    compile: bool = False
    """Compile each decoder layer with torch.compile during load."""
    warm_prompt_tokens: tuple[int, int] = (12, 40)
    """Prompt lengths, first and last, made ready during load on CUDA; others are made ready at first use."""
    threads: Annotated[int, Field(ge=1)] | None = None
    """CPU threads of torch in this process; None leaves torch's own choice."""

    @model_validator(mode="after")
    def _check_range(self) -> TorchRuntimeConfig:
        first, last = self.warm_prompt_tokens
        if not 1 <= first <= last:
            raise ValueError(f"warm_prompt_tokens is ({first}, {last}), expected 1 <= first <= last")
        return self
