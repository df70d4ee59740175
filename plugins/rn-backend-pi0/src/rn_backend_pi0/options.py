"""Options under `[plugins.pi0]` and `[plugins.pi0-fast]`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rn_backend_pi0.chunking import Jacobian, Schedule
from rn_backend_pi0.fast_tokens import FastLength
from rn_backend_pi0.image import Resize
from rn_backend_pi0.profile_options import ProfileOptions
from roboneuron import ConfigurationOnly

Role = Annotated[str, Field(pattern=r"^([a-z][a-z0-9_]*|-)$")]


class NativeOptions(ProfileOptions):
    """Options of the backends that run a checkpoint in this process."""

    checkpoint: Annotated[Path, ConfigurationOnly()] = Field(
        description="directory of a LeRobot or openpi PyTorch checkpoint"
    )
    tokenizer: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="tokenizer.json; the checkpoint's own if unset"
    )
    asset_id: str | None = Field(
        default=None, description="statistics to use from an openpi checkpoint that has several"
    )
    camera_slots: tuple[Role, ...] | None = Field(
        default=None, description="camera role for each slot of the model, '-' for an empty one"
    )
    optional_roles: tuple[Role, ...] = Field(
        default=("wrist", "right_wrist"),
        description="roles that may be absent; their slot is then masked",
    )
    device: str = Field(
        default="auto",
        pattern=r"^(auto|cpu|cuda(:\d+)?)$",
        description="auto takes a GPU if there is one",
    )
    dtype: Literal["auto", "float32", "bfloat16"] = Field(
        default="auto", description="auto is bfloat16 on a GPU and float32 on a CPU"
    )
    cpu_threads: int | None = Field(
        default=None,
        ge=1,
        le=512,
        description="threads of PyTorch in this process; PyTorch's default if unset",
    )
    numerics: Literal["lerobot", "openpi"] | None = Field(
        default=None,
        description="family whose rounding, resizing and eps are used; the one that wrote the "
        "checkpoint if unset",
    )
    resize: Resize | None = Field(
        default=None,
        description="'antialiased' as in openpi, 'plain' as in LeRobot; by numerics if unset",
    )


class Pi0Options(NativeOptions):
    """Options of the backend "pi0"."""

    state_in_prompt: bool = Field(
        default=True,
        description="pi0.5: the prompt contains the state; false for checkpoints trained "
        "without it (openpi's pi05_libero), which get no state at all",
    )
    denoising_steps: int | None = Field(
        default=None, ge=1, le=1000, description="Euler steps; the checkpoint's if unset"
    )
    seed: Annotated[int, Field(ge=0)] | Literal["random"] = Field(
        default=0,
        description="seed of the noise, restarted by every reset; 'random' for a new one each time",
    )
    noise: Literal["fresh", "fixed"] = Field(
        default="fresh", description="'fixed' starts every inference from the same noise"
    )
    rtc: bool = Field(
        default=True, description="continue rows executed during inference (real-time chunking)"
    )
    rtc_schedule: Schedule = Field(
        default="linear",
        description="decrease of the guidance after the committed rows",
    )
    rtc_horizon: int | None = Field(
        default=None, ge=1, description="number of guided rows; all remaining ones if unset"
    )
    rtc_max_weight: float = Field(
        default=10.0, gt=0, le=1000, description="largest weight of the guidance"
    )
    rtc_jacobian: Jacobian = Field(
        default="identity",
        description="'full' adds a backward pass to each step, as in the paper; slower",
    )

    @property
    def numpy_seed(self) -> int | None:
        """The seed in numpy's form."""
        return None if self.seed == "random" else self.seed

    @model_validator(mode="after")
    def _fixed_noise_has_a_seed(self) -> Self:
        if self.noise == "fixed" and self.seed == "random":
            raise ValueError("noise 'fixed' needs a seed")
        return self


class Pi0FastOptions(NativeOptions):
    """Options of the backend "pi0-fast"."""

    action_tokenizer: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None,
        description="directory of the action tokenizer's files; the checkpoint's "
        "action_tokenizer if unset",
    )
    max_outside_share: float = Field(
        default=0.15,
        ge=0,
        le=1,
        description="largest accepted fraction of an answer's tokens for which the model "
        "prefers another token over every action token",
    )
    fast_length: FastLength = Field(
        default="exact",
        description="'padded' fills coefficients missing at the end with 0 and "
        "drops extra ones, as LeRobot does",
    )
