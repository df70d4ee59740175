"""Description of a checkpoint in one of the two public layouts of the pi0 family, LeRobot's and
openpi's. Weights are not read.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pydantic import TypeAdapter

from rn_backend_pi0.checkpoint import PROFILE_FILE, Pi0Checkpoint
from rn_backend_pi0.dimensions import read_dims
from rn_backend_pi0.documents import (
    LerobotConfig,
    OpenpiConfig,
    ProfileDocument,
)
from rn_backend_pi0.lerobot_layout import LEROBOT_VARIANTS, PROMPT_LENGTH, read_lerobot
from rn_backend_pi0.tensor_names import read_names, variant_of
from rn_vla.checkpoint_files import (
    check_schema,
    clip,
    explain_families,
    list_names,
    read_json,
    read_schema,
)
from rn_vla.normalisation import ScalingKind, read_openpi_scalings
from roboneuron import CheckpointError

OPENPI_SLOTS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
"""Camera slots of every openpi pi0. Source: openpi, models/model.py."""


def read_checkpoint(directory: Path, *, asset_id: str | None = None) -> Pi0Checkpoint:
    """Describe the checkpoint in `directory`.

    Args:
        directory: a LeRobot checkpoint (config.json with "type": "pi0" and policy_*.json) or an
            openpi PyTorch checkpoint (config.json with "action_horizon", and assets/<asset
            id>/norm_stats.json).
        asset_id: chosen assets of an openpi checkpoint; only needed when it has several.

    Raises:
        CheckpointError: not a pi0 checkpoint, or a file is missing or invalid; the message names it
            and the remedy.
    """
    if not directory.is_dir():
        raise CheckpointError(
            f"Checkpoint {str(directory)!r} is not a directory.", hint=f"Looked in {Path.cwd()}."
        )
    path = directory / "config.json"
    config = read_json(path)
    if not isinstance(config, dict):
        raise CheckpointError(f"{path} holds a {type(config).__name__}, expected an object.")
    kind = config.get("type", config.get("model_type"))
    variant = LEROBOT_VARIANTS.get(kind) if isinstance(kind, str) else None
    if kind is not None and variant is None:
        raise CheckpointError(
            f"{path} describes a {clip(repr(kind))} model, this backend runs "
            f"{', '.join(LEROBOT_VARIANTS)}.",
            hint=explain_families(kind),
        )
    if variant is not None:
        read = check_schema(config, TypeAdapter(LerobotConfig), path)
        checkpoint = read_lerobot(directory, read, variant)
    elif "action_horizon" in config:
        checkpoint = _openpi(
            directory, check_schema(config, TypeAdapter(OpenpiConfig), path), asset_id
        )
    else:
        raise CheckpointError(
            f'{path} has neither "type": "pi0", "pi05" or "pi0_fast" (LeRobot) nor '
            f'"action_horizon" (openpi); '
            f"keys: {list_names(sorted(config))}.",
            hint="Give the directory of a pi0 checkpoint; JAX checkpoints are converted by "
            "openpi's own script.",
        )
    sidecar = directory / PROFILE_FILE
    if sidecar.is_symlink() or sidecar.exists():
        checkpoint = replace(checkpoint, profile=read_schema(sidecar, ProfileDocument).profile)
    return checkpoint


def _openpi(directory: Path, config: OpenpiConfig, asset_id: str | None) -> Pi0Checkpoint:
    path = directory / "config.json"
    found = sorted(p.parent.name for p in directory.glob("assets/*/norm_stats.json"))
    nested = sorted(
        str(p.parent.relative_to(directory / "assets"))
        for p in directory.glob("assets/*/*/norm_stats.json")
    )
    choices = found + nested
    flat = directory / "norm_stats.json"
    if asset_id is not None and asset_id not in choices:
        raise CheckpointError(
            f"asset_id {clip(asset_id)!r} is not in {directory / 'assets'}; choose one of "
            f"{list_names(choices)}."
        )
    if asset_id is None and len(choices) > 1:
        raise CheckpointError(
            f"{directory / 'assets'} holds several statistics; set asset_id to one of "
            f"{list_names(choices)}."
        )
    if not choices and not flat.exists():
        raise CheckpointError(
            f"{directory} has no assets/<asset id>/norm_stats.json.",
            hint="Copy the assets directory of the original checkpoint beside model.safetensors.",
        )
    source = (
        directory / "assets" / (asset_id or choices[0]) / "norm_stats.json" if choices else flat
    )
    variant = variant_of(read_names(directory))
    # openpi normalises pi0 by z-scores, all others by quantiles
    kind: ScalingKind = "quantiles" if variant == "pi05" else "mean_std"
    state, action = read_openpi_scalings(source, kind)
    chunk = config.action_horizon
    dims = read_dims(
        config,
        path,
        chunk=chunk,
        state=config.action_dim,
        action=config.action_dim,
        variant=variant,
    )
    return Pi0Checkpoint(
        directory=directory,
        family="openpi",
        dims=dims,
        slots=OPENPI_SLOTS,
        state=state,
        action=action,
        action_steps=chunk,
        prompt_length=config.max_token_len or PROMPT_LENGTH[variant],
    )
