"""What a user may set under `[plugins.pi0]` and `[plugins.pi0-fast]`."""

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
        default=None, description="tokenizer.json; the checkpoint's own when not given"
    )
    asset_id: str | None = Field(
        default=None, description="which statistics of an openpi checkpoint that has several"
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
        description="threads of PyTorch in this process; PyTorch's own choice if unset",
    )
    numerics: Literal["lerobot", "openpi"] | None = Field(
        default=None,
        description="whose rounding, resizing and eps to follow; the family that wrote the "
        "checkpoint if unset",
    )
    resize: Resize | None = Field(
        default=None,
        description="'antialiased' as openpi serves, 'plain' as LeRobot; by numerics if unset",
    )


class Pi0Options(NativeOptions):
    """Options of the backend "pi0"."""

    state_in_prompt: bool = Field(
        default=True,
        description="pi0.5: the prompt names the state; false for checkpoints that were trained "
        "without (openpi's pi05_libero), which see no state at all",
    )
    denoising_steps: int | None = Field(
        default=None, ge=1, le=1000, description="Euler steps; the checkpoint's if unset"
    )
    seed: Annotated[int, Field(ge=0)] | Literal["random"] = Field(
        default=0,
        description="of the noise, restarted by every reset; 'random' for another one each time",
    )
    noise: Literal["fresh", "fixed"] = Field(
        default="fresh", description="'fixed' starts every inference from the same noise"
    )
    rtc: bool = Field(
        default=True, description="continue the rows that are played meanwhile (real-time chunking)"
    )
    rtc_schedule: Schedule = Field(
        default="linear",
        description="how the guidance falls after the rows that will be played in any case",
    )
    rtc_horizon: int | None = Field(
        default=None, ge=1, description="rows that are guided; all that are left if unset"
    )
    rtc_max_weight: float = Field(
        default=10.0, gt=0, le=1000, description="greatest weight of the guidance"
    )
    rtc_jacobian: Jacobian = Field(
        default="identity",
        description="'full' adds a backward pass to each step, as in the paper; slower",
    )

    @property
    def numpy_seed(self) -> int | None:
        """The seed as numpy takes it."""
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
        "action_tokenizer when not given",
    )
    max_outside_share: float = Field(
        default=0.15,
        ge=0,
        le=1,
        description="share of an answer's tokens for which another token than every "
        "action token may be the likeliest; more is refused",
    )
    fast_length: FastLength = Field(
        default="exact",
        description="'padded' takes coefficients that are missing at the end as 0 and "
        "drops surplus ones, as LeRobot does",
    )
