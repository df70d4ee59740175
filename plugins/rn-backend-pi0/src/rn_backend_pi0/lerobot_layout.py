"""LeRobot's layout of a checkpoint: config.json, and pipelines with their statistics."""

from __future__ import annotations

from pathlib import Path

from pydantic import TypeAdapter

from rn_backend_pi0.architecture import Variant
from rn_backend_pi0.checkpoint import FastSettings, Pi0Checkpoint
from rn_backend_pi0.dimensions import read_dims
from rn_backend_pi0.documents import (
    LerobotConfig,
    ProcessorDocument,
    ProcessorStep,
    StepConfig,
)
from rn_vla.checkpoint_files import (
    check_file,
    check_safetensors,
    check_schema,
    clip,
    list_names,
    read_schema,
    reading,
)
from rn_vla.normalisation import Moments, Quantiles, Range, Scaling, ZScore
from roboneuron import CheckpointError

_IMAGES = "observation.images."
_STATE_IN_PROMPT = "pi05_prepare_state_tokenizer_processor_step"
_KNOWN_STEPS = frozenset(
    {
        "rename_observations_processor",
        "to_batch_processor",
        "pi0_new_line_processor",
        _STATE_IN_PROMPT,
        "pi0_fast_prepare_state_tokenizer_processor_step",
        "action_tokenizer_processor",
        "tokenizer_processor",
        "device_processor",
        "normalizer_processor",
        "unnormalizer_processor",
        "relative_actions_processor",
        "absolute_actions_processor",
    }
)
LEROBOT_VARIANTS: dict[str, Variant] = {"pi0": "pi0", "pi05": "pi05", "pi0_fast": "pi0_fast"}
"""Variant by "type" of config.json."""
_STATISTICS = {"MEAN_STD": ("mean", "std"), "QUANTILES": ("q01", "q99")}
_MODES: dict[Variant, tuple[str, ...]] = {
    "pi0": ("MEAN_STD",),
    "pi05": tuple(_STATISTICS),
    "pi0_fast": tuple(_STATISTICS),
}
"""Supported normalisations of state and actions."""
PROMPT_LENGTH: dict[Variant, int] = {"pi0": 48, "pi05": 200, "pi0_fast": 200}
"""Largest number of tokens of a prompt, if config.json does not give it. Source: openpi and
LeRobot.
"""
_NO_MEMORY = "Only models without use_visual_memory and use_proprioceptive_memory are run."
_MAX_SLOTS = 16
_MAX_STATISTICS_BYTES = 2**20


def read_lerobot(directory: Path, config: LerobotConfig, variant: Variant) -> Pi0Checkpoint:
    """Describe a checkpoint in LeRobot's layout.

    Raises:
        CheckpointError: a file is missing or invalid; the message names it and the remedy.
    """
    path = directory / "config.json"
    modes: dict[str, str] = {}
    for kind in ("VISUAL", "STATE", "ACTION"):
        expected = ("IDENTITY",) if kind == "VISUAL" else _MODES[variant]
        got = config.normalization_mapping.get(kind)
        if got not in expected:
            raise CheckpointError(
                f"{path}: normalization_mapping.{kind} is {got!r}; this backend reads "
                f"{' or '.join(map(repr, expected))} only."
            )
        modes[kind] = got
    if config.use_visual_memory or config.use_proprioceptive_memory:
        raise CheckpointError(f"{path}: the model remembers earlier observations.", hint=_NO_MEMORY)
    slots = [
        name.removeprefix(_IMAGES)
        for name, f in config.input_features.items()
        if f.type == "VISUAL"
    ]
    slots += [f"empty_camera_{i}" for i in range(config.empty_cameras)]
    slots = list(dict.fromkeys(slots))
    if not 0 < len(slots) <= _MAX_SLOTS:
        raise CheckpointError(
            f"{path}: input_features names {len(slots)} images, pi0 needs 1 to {_MAX_SLOTS}."
        )
    pre, post = directory / "policy_preprocessor.json", directory / "policy_postprocessor.json"
    if not pre.exists() and not post.exists():
        raise CheckpointError(
            f"{directory} has no {pre.name} and {post.name}, which hold the statistics of state "
            "and actions.",
            hint="Checkpoints of LeRobot before 0.4 must be migrated with LeRobot's own migration "
            "script.",
        )
    before, after = _steps(pre), _steps(post)
    relative = _is_relative(before, pre) or _is_relative(after, post)
    dims = read_dims(
        config,
        path,
        chunk=config.chunk_size,
        state=config.max_state_dim,
        action=config.max_action_dim if variant != "pi0_fast" else _action_width(config, path),
        variant=variant,
    )
    resolution = config.image_resolution
    if resolution not in (None, (dims.vision.image, dims.vision.image)):
        raise CheckpointError(
            f"{path}: image_resolution is {resolution}, the vision tower takes {dims.vision.image}."
        )
    prompt = before.get(_STATE_IN_PROMPT)
    if prompt is not None and not _settings(prompt, pre).include_state_in_prompt:
        raise CheckpointError(f"{pre}: the prompt lacks the state.", hint=_NO_MEMORY)
    state = _lerobot_statistics(
        directory, pre, before, ("normalizer_processor", "observation.state", modes["STATE"])
    )
    action = _lerobot_statistics(
        directory, post, after, ("unnormalizer_processor", "action", modes["ACTION"])
    )
    return Pi0Checkpoint(
        directory=directory,
        family="lerobot",
        dims=dims,
        slots=tuple(slots),
        state=state,
        action=action,
        denoising_steps=config.num_inference_steps,
        action_steps=min(config.chunk_size, config.n_action_steps or config.chunk_size),
        prompt_length=config.tokenizer_max_length or PROMPT_LENGTH[variant],
        relative_actions=relative,
        trained_prefix_rows=min(config.chunk_size, config.rtc_training_max_delay or 0),
        fast=_fast_settings(config, path) if variant == "pi0_fast" else None,
    )


def _action_width(config: LerobotConfig, path: Path) -> int:
    """Number of values of one row of the action tokens."""
    action = config.output_features.get("action")
    if action is None or len(action.shape) != 1:
        raise CheckpointError(f"{path}: output_features has no width of 'action'.")
    return action.shape[0]


def _fast_settings(config: LerobotConfig, path: Path) -> FastSettings:
    if config.temperature:
        raise CheckpointError(
            f"{path}: temperature is {config.temperature:g}; only greedy decoding is supported."
        )
    return FastSettings(skip_tokens=config.fast_skip_tokens, most_tokens=config.max_decoding_steps)


def _steps(path: Path) -> dict[str, ProcessorStep]:
    """Step by registry name. Raises CheckpointError for a step this backend does not know."""
    steps: dict[str, ProcessorStep] = {}
    for step in read_schema(path, ProcessorDocument).steps:
        if step.registry_name not in _KNOWN_STEPS:
            raise CheckpointError(
                f"{path}: step {step.registry_name!r} is unknown; known are "
                f"{', '.join(sorted(_KNOWN_STEPS))}.",
                hint="A step that is left out would change the actions, so this checkpoint is "
                "refused.",
            )
        steps[step.registry_name] = step
    return steps


def _settings(step: ProcessorStep, path: Path) -> StepConfig:
    return check_schema(step.config, TypeAdapter(StepConfig), path)


def _is_relative(steps: dict[str, ProcessorStep], path: Path) -> bool:
    enabled = False
    for name in ("relative_actions_processor", "absolute_actions_processor"):
        if name in steps:
            settings = _settings(steps[name], path)
            enabled = enabled or settings.enabled
            if enabled and settings.exclude_joints != ("gripper",):
                kept = list_names(settings.exclude_joints or ()) or "nothing"
                raise CheckpointError(
                    f"{path}: {name} leaves {kept} absolute; only 'gripper' can be followed."
                )
    return enabled


def _lerobot_statistics(
    directory: Path, path: Path, steps: dict[str, ProcessorStep], wanted: tuple[str, str, str]
) -> Scaling:
    """Statistics of `wanted`: registry name of the step, feature, normalisation."""
    name, feature, mode = wanted
    if name not in steps:
        raise CheckpointError(
            f"{path} has no step {name!r}, so the statistics of {feature!r} are unknown."
        )
    state_file = steps[name].state_file
    if state_file is None:
        raise CheckpointError(f"{path}: state_file of {name!r} is missing, expected a file name.")
    source = directory / state_file
    tensors = _read_tensors(source)
    keys = [f"{feature}.{kind}" for kind in _STATISTICS[mode]]
    absent = [key for key in keys if key not in tensors]
    if absent:
        raise CheckpointError(
            f"{source} lacks {', '.join(absent)}; it holds {list_names(sorted(tensors))}."
        )
    found = {key.rpartition(".")[2]: tensors[key] for key in keys}
    if mode == "QUANTILES":
        limits = check_schema(found, TypeAdapter(Range), source)
        return Quantiles.of(limits.q01, limits.q99, eps=0.0)
    moments = check_schema(found, TypeAdapter(Moments), source)
    # LeRobot adds eps when it divides, but not when it multiplies back.
    return ZScore.of(
        moments.mean, moments.std, forward_eps=_settings(steps[name], path).eps, backward_eps=0.0
    )


def _read_tensors(path: Path) -> dict[str, object]:
    from safetensors.numpy import load_file  # heavy

    check_file(path, _MAX_STATISTICS_BYTES)
    check_safetensors(path)
    with reading(path, "safetensors"):
        tensors = load_file(path)
    for name, values in tensors.items():
        if values.dtype.kind != "f":
            raise CheckpointError(
                f"{path}: {clip(name)!r} has the number type {values.dtype}, expected real numbers."
            )
    return {name: values.tolist() for name, values in tensors.items()}
