"""Describes a checkpoint in one of the two public layouts of pi0: LeRobot's and openpi's. No weights are read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rn_backend_pi0.checkpoint import PROFILE_FILE, Checkpoint
from rn_backend_pi0.dimensions import read_dims
from rn_backend_pi0.documents import Document, read_document, take_integer, take_list, take_number, take_object
from rn_backend_pi0.statistics import ZScore, check_statistics
from roboneuron.errors import CheckpointError

OPENPI_SLOTS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
"""Camera slots of every openpi pi0. Source: openpi, models/model.py."""
_IMAGES = "observation.images."
_KNOWN_STEPS = frozenset(
    {
        "rename_observations_processor",
        "to_batch_processor",
        "pi0_new_line_processor",
        "tokenizer_processor",
        "device_processor",
        "normalizer_processor",
        "unnormalizer_processor",
        "relative_actions_processor",
        "absolute_actions_processor",
    }
)
_OPENPI_EPS = 1e-6


def read_checkpoint(directory: Path, *, asset_id: str | None = None) -> Checkpoint:
    """Describe the checkpoint in `directory`.

    Args:
        directory: a LeRobot checkpoint (config.json with "type": "pi0" and policy_*.json) or an openpi PyTorch
            checkpoint (config.json with "action_horizon", and assets/<asset id>/norm_stats.json).
        asset_id: which assets of an openpi checkpoint; only needed when it has several.

    Raises:
        CheckpointError: not a pi0 checkpoint, or a file is missing or cannot be used; says which and what to do.
    """
    if not directory.is_dir():
        raise CheckpointError(f"Checkpoint {str(directory)!r} is not a directory.", hint=f"Looked in {Path.cwd()}.")
    path = directory / "config.json"
    config = read_document(path)
    kind = config.get("type", config.get("model_type"))
    if kind is not None and kind != "pi0":
        raise CheckpointError(
            f"{path} describes a {str(kind)!r} model, this backend runs 'pi0'.",
            hint="Choose the backend of that family.",
        )
    if kind == "pi0":
        checkpoint = read_lerobot(directory, config)
    elif "action_horizon" in config:
        checkpoint = read_openpi(directory, config, asset_id)
    else:
        raise CheckpointError(
            f'{path} has neither "type": "pi0" (LeRobot) nor "action_horizon" (openpi); keys: {sorted(config)[:12]}.',
            hint="Give the directory of a pi0 checkpoint; JAX checkpoints are converted by openpi's own script.",
        )
    sidecar = directory / PROFILE_FILE
    if sidecar.is_file():
        checkpoint = replace(checkpoint, profile=str(read_document(sidecar).get("profile", "")))
    return checkpoint


def read_lerobot(directory: Path, config: Document) -> Checkpoint:
    """Describe a LeRobot checkpoint. Raises CheckpointError."""
    path = directory / "config.json"
    norms = take_object(config, "normalization_mapping", path)
    for kind, expected in (("VISUAL", "IDENTITY"), ("STATE", "MEAN_STD"), ("ACTION", "MEAN_STD")):
        if norms.get(kind) != expected:
            raise CheckpointError(
                f"{path}: normalization_mapping.{kind} is {norms.get(kind)!r}; this backend reads {expected!r} only."
            )
    slots = [
        name.removeprefix(_IMAGES)
        for name, feature in take_object(config, "input_features", path).items()
        if isinstance(feature, dict) and feature.get("type") == "VISUAL"
    ]
    slots += [f"empty_camera_{i}" for i in range(_count(config, "empty_cameras"))]
    slots = list(dict.fromkeys(slots))
    if not slots:
        raise CheckpointError(f"{path}: input_features names no image, pi0 needs at least one.")
    pre, post = directory / "policy_preprocessor.json", directory / "policy_postprocessor.json"
    if not pre.is_file() and not post.is_file():
        raise CheckpointError(
            f"{directory} has no {pre.name} and {post.name}, which hold the statistics of state and actions.",
            hint="Checkpoints of LeRobot before 0.4 must be migrated with LeRobot's own migration script.",
        )
    before, after = _steps(pre), _steps(post)
    relative = _is_relative(before, pre) or _is_relative(after, post)
    chunk = take_integer(config, "chunk_size", path, 50)
    dims = read_dims(
        config,
        path,
        chunk=chunk,
        state=take_integer(config, "max_state_dim", path, 32),
        action=take_integer(config, "max_action_dim", path, 32),
    )
    resolution = config.get("image_resolution", [dims.vision.image] * 2)
    if resolution != [dims.vision.image] * 2:
        raise CheckpointError(f"{path}: image_resolution is {resolution}, the vision tower takes {dims.vision.image}.")
    return Checkpoint(
        directory=directory,
        family="lerobot",
        dims=dims,
        slots=tuple(slots),
        state=_lerobot_statistics(directory, pre, before, "normalizer_processor", "observation.state"),
        action=_lerobot_statistics(directory, post, after, "unnormalizer_processor", "action"),
        denoising_steps=take_integer(config, "num_inference_steps", path, 10),
        action_steps=min(chunk, take_integer(config, "n_action_steps", path, chunk)),
        prompt_length=take_integer(config, "tokenizer_max_length", path, 48),
        relative_actions=relative,
    )


def _count(config: Document, key: str) -> int:
    value = config.get(key, 0)
    return value if isinstance(value, int) and value > 0 else 0


def _steps(path: Path) -> dict[str, Document]:
    """Step by registry name. Raises CheckpointError for a step this backend does not know."""
    steps: dict[str, Document] = {}
    for step in take_list(read_document(path), "steps", path):
        name = str(step.get("registry_name")) if isinstance(step, dict) else ""
        if not isinstance(step, dict) or name not in _KNOWN_STEPS:
            raise CheckpointError(
                f"{path}: step {name or step!r} is unknown; known are {', '.join(sorted(_KNOWN_STEPS))}.",
                hint="A step that is left out would change the actions, so this checkpoint is refused.",
            )
        steps[name] = step
    return steps


def _is_relative(steps: dict[str, Document], path: Path) -> bool:
    enabled = False
    for name in ("relative_actions_processor", "absolute_actions_processor"):
        if name in steps:
            config = take_object(steps[name], "config", path)
            enabled = enabled or bool(config.get("enabled"))
            if enabled and config.get("exclude_joints", ["gripper"]) != ["gripper"]:
                raise CheckpointError(
                    f"{path}: {name} leaves {config['exclude_joints']} absolute; only ['gripper'] can be followed."
                )
    return enabled


def _lerobot_statistics(directory: Path, path: Path, steps: dict[str, Document], name: str, feature: str) -> ZScore:
    if name not in steps:
        raise CheckpointError(f"{path} has no step {name!r}, so the statistics of {feature!r} are unknown.")
    state_file = steps[name].get("state_file")
    if not isinstance(state_file, str) or Path(state_file).name != state_file:
        raise CheckpointError(f"{path}: state_file of {name!r} is {state_file!r}, expected a file name.")
    source = directory / state_file
    tensors = _read_tensors(source)
    absent = [key for key in (f"{feature}.mean", f"{feature}.std") if key not in tensors]
    if absent:
        raise CheckpointError(f"{source} lacks {', '.join(absent)}; it holds {', '.join(sorted(tensors))}.")
    eps = take_number(take_object(steps[name], "config", path), "eps", path, 1e-8)
    # LeRobot adds eps when it divides, and nothing when it multiplies back.
    return check_statistics(
        tensors[f"{feature}.mean"],
        tensors[f"{feature}.std"],
        what=feature,
        source=str(source),
        forward_eps=eps,
        backward_eps=0.0,
    )


def _read_tensors(path: Path) -> dict[str, object]:
    from safetensors import SafetensorError  # heavy
    from safetensors.numpy import load_file

    try:
        return dict(load_file(path))
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}.") from error


def read_openpi(directory: Path, config: Document, asset_id: str | None) -> Checkpoint:
    """Describe an openpi PyTorch checkpoint. Raises CheckpointError."""
    path = directory / "config.json"
    found = sorted(p.parent.name for p in directory.glob("assets/*/norm_stats.json"))
    nested = sorted(
        str(p.parent.relative_to(directory / "assets")) for p in directory.glob("assets/*/*/norm_stats.json")
    )
    choices = found + nested
    flat = directory / "norm_stats.json"
    if asset_id is not None and asset_id not in choices:
        raise CheckpointError(f"asset_id {asset_id!r} is not in {directory / 'assets'}; choose one of {choices}.")
    if asset_id is None and len(choices) > 1:
        raise CheckpointError(f"{directory / 'assets'} holds several statistics; set asset_id to one of {choices}.")
    if not choices and not flat.is_file():
        raise CheckpointError(
            f"{directory} has no assets/<asset id>/norm_stats.json.",
            hint="Copy the assets directory of the original checkpoint beside model.safetensors.",
        )
    source = directory / "assets" / (asset_id or choices[0]) / "norm_stats.json" if choices else flat
    stats = take_object(read_document(source), "norm_stats", source)
    width = take_integer(config, "action_dim", path)
    chunk = take_integer(config, "action_horizon", path)
    return Checkpoint(
        directory=directory,
        family="openpi",
        dims=read_dims(config, path, chunk=chunk, state=width, action=width),
        slots=OPENPI_SLOTS,
        state=_openpi_statistics(take_object(stats, "state", source), "state", source),
        action=_openpi_statistics(take_object(stats, "actions", source), "actions", source),
        action_steps=chunk,
        prompt_length=take_integer(config, "max_token_len", path, 48),
    )


def _openpi_statistics(block: Document, what: str, source: Path) -> ZScore:
    return check_statistics(
        block.get("mean"),
        block.get("std"),
        what=what,
        source=str(source),
        forward_eps=_OPENPI_EPS,
        backward_eps=_OPENPI_EPS,
    )
