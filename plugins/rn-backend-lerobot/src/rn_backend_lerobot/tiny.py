"""Tiny random checkpoints, written by LeRobot's own classes in its own layout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal, cast, get_args

from rn_backend_lerobot.isolation import check_release, installed_release
from rn_backend_lerobot.tiny_checkpoint import Saved, TinyShape, write_policy
from rn_backend_lerobot.tiny_language import write_pi0, write_pi05, write_smolvla, write_xvla
from roboneuron import ConfigurationError

Policy = Literal["act", "diffusion", "vqbet", "smolvla", "pi0", "pi05", "xvla"]
POLICIES: tuple[Policy, ...] = get_args(Policy)
PATCHED: tuple[Policy, ...] = ("pi0", "pi05")
"""Policies that load only within `small_gemma`."""


def make_tiny(
    directory: Path, policy: Policy, shape: TinyShape | None = None, *, seed: int = 0
) -> None:
    """Write a checkpoint of random weights into a new or empty directory.

    Raises:
        ConfigurationError: the directory is not empty, or the policy is none of `POLICIES`.
        MissingDependencyError: LeRobot is missing, or of another release.
    """
    if policy not in POLICIES:
        raise ConfigurationError(
            f"There is no tiny {policy!r}; choose one of: {', '.join(POLICIES)}."
        )
    if directory.exists() and any(directory.iterdir()):
        raise ConfigurationError(f"{directory} is not empty.")
    check_release(installed_release())
    import torch  # heavy

    directory.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(seed)
    _WRITERS[policy](directory.resolve(), shape or TinyShape())


def _write_act(directory: Path, shape: TinyShape) -> None:
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    write_policy(
        directory,
        shape,
        ACTConfig,
        ACTPolicy,
        chunk_size=16,
        n_action_steps=8,
        dim_model=32,
        n_heads=2,
        dim_feedforward=64,
        n_encoder_layers=1,
        n_decoder_layers=1,
        n_vae_encoder_layers=1,
        latent_dim=8,
        pretrained_backbone_weights=None,
    )


def _write_diffusion(directory: Path, shape: TinyShape) -> None:
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    write_policy(
        directory,
        shape,
        DiffusionConfig,
        DiffusionPolicy,
        n_obs_steps=2,
        horizon=16,
        n_action_steps=8,
        down_dims=(32, 64),
        diffusion_step_embed_dim=16,
        spatial_softmax_num_keypoints=8,
        noise_scheduler_type="DDIM",
        num_inference_steps=2,
        pretrained_backbone_weights=None,
    )


def _write_vqbet(directory: Path, shape: TinyShape) -> None:
    from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
    from lerobot.policies.vqbet.modeling_vqbet import VQBeTPolicy

    def trained(config: object) -> Saved:
        policy = VQBeTPolicy(config)
        # as after the first phase of training: otherwise LeRobot warns at each action
        policy.vqbet.action_head.vqvae_model.discretized.fill_(True)
        return cast("Saved", policy)

    write_policy(
        directory,
        replace(shape, cameras=shape.cameras[:1]),  # it takes one
        VQBeTConfig,
        trained,
        n_obs_steps=2,
        n_action_pred_token=2,
        action_chunk_size=5,
        crop_shape=(64, 64),
        spatial_softmax_num_keypoints=8,
        vqvae_n_embed=4,
        vqvae_embedding_dim=16,
        vqvae_enc_hidden_dim=16,
        gpt_input_dim=32,
        gpt_output_dim=32,
        gpt_n_layer=1,
        gpt_n_head=2,
        gpt_hidden_dim=32,
        pretrained_backbone_weights=None,
    )


_WRITERS: dict[Policy, Callable[[Path, TinyShape], None]] = {
    "act": _write_act,
    "diffusion": _write_diffusion,
    "vqbet": _write_vqbet,
    "smolvla": write_smolvla,
    "pi0": write_pi0,
    "pi05": write_pi05,
    "xvla": write_xvla,
}
