"""A LeRobot checkpoint folder, read without LeRobot: JSON and the headers of safetensors files.

Source: the layout that `save_pretrained` of lerobot 0.6.1 writes for policies and processors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from rn_backend_lerobot.provenance import check_folder, find_references
from rn_backend_lerobot.tensor_file import read_tensors
from rn_vla.checkpoint_files import (
    check_safetensors,
    check_schema,
    list_names,
    read_json,
    read_schema,
)
from roboneuron import CheckpointError

CONFIG, WEIGHTS = "config.json", "model.safetensors"
PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"
STATE, ACTION = "observation.state", "action"
IMAGES = "observation.images."
NORMALIZER, UNNORMALIZER = "normalizer_processor", "unnormalizer_processor"
ROW_BY_ROW = ("tdmpc", "gaussian_actor")
"""Policies that return one action per call although they use a single observation."""
_NEEDED: dict[str, tuple[str, ...]] = {
    "IDENTITY": (),
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""Statistics required by each mode of normalisation."""
_MIGRATE = (
    "Convert it with LeRobot's own command: python -m "
    "lerobot.processor.migrate_policy_normalization --pretrained-path FOLDER"
)


class _CheckpointDocument(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class FeatureDocument(_CheckpointDocument):
    """Type and shape of one feature."""

    type: str
    shape: tuple[int, ...]


class PolicyDocument(_CheckpointDocument):
    """The keys used of config.json."""

    type: str
    n_obs_steps: int = 1
    input_features: dict[str, FeatureDocument] | None = None
    output_features: dict[str, FeatureDocument] | None = None
    normalization_mapping: dict[str, str] | None = None
    chunk_size: int | None = None
    n_action_steps: int | None = None
    temporal_ensemble_coeff: float | None = None
    use_peft: bool = False
    use_relative_actions: bool = False
    action_feature_names: tuple[str, ...] | None = None


class StepDocument(_CheckpointDocument):
    """One step of a processor."""

    registry_name: str = ""
    config: dict[str, object] = Field(default_factory=dict)
    state_file: str | None = None


class PipelineDocument(_CheckpointDocument):
    """Steps of a processor."""

    steps: tuple[StepDocument, ...]


class NormalizerDocument(_CheckpointDocument):
    """Configuration of a step that normalises or un-normalises."""

    features: dict[str, FeatureDocument]
    norm_map: dict[str, str]


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageFeature:
    """An image input of the policy.

    Attributes:
        key: "observation.images.front".
        height, width: image size of the training data [px].
    """

    key: str
    height: int
    width: int

    @property
    def short(self) -> str:
        """The key without its prefix: "front"."""
        return self.key.removeprefix(IMAGES)


@dataclass(frozen=True, kw_only=True, slots=True)
class PolicyFolder:
    """The contents of a checkpoint folder.

    Attributes:
        directory: folder of the checkpoint.
        family: LeRobot's name of the policy: "act", "smolvla".
        images: in the order of config.json.
        state: number of values of `observation.state`; 0 without.
        action: number of values of an action.
        names: names of the action's values in order; empty if the checkpoint has none.
        rows: number of rows of a chunk that are executed.
        remembers: True if an action depends on earlier observations; such a policy is queried for
            one row at a time.
        steps: registry names of the preprocessor's steps.
        references: local folder of each backbone and tokenizer that the checkpoint names.
    """

    directory: Path
    family: str
    images: tuple[ImageFeature, ...]
    state: int
    action: int
    names: tuple[str, ...]
    rows: int
    remembers: bool
    steps: tuple[str, ...]
    references: Mapping[str, Path]


def read_folder(directory: Path, folders: Mapping[str, Path]) -> PolicyFolder:
    """Read and check a checkpoint; weights are not read.

    Args:
        directory: folder of the checkpoint.
        folders: local folder by the hub's name.

    Raises:
        CheckpointError: the first part that is missing, damaged or refused.
    """
    check_folder(directory)
    raw = read_json(directory / CONFIG)
    policy = check_schema(raw, TypeAdapter(PolicyDocument), directory / CONFIG)
    if policy.use_peft or (directory / "adapter_config.json").exists():
        raise CheckpointError(
            f"{directory} holds a PEFT adapter, not a whole policy.",
            hint="Merge it into its base policy with LeRobot, and save that.",
        )
    check_safetensors(directory / WEIGHTS)
    for name in (PREPROCESSOR, POSTPROCESSOR):
        if not (directory / name).exists():
            raise CheckpointError(f"{directory} has no {name}.", hint=_MIGRATE)
    documents = {
        CONFIG: raw,
        PREPROCESSOR: read_json(directory / PREPROCESSOR),
        POSTPROCESSOR: read_json(directory / POSTPROCESSOR),
    }
    references = find_references(documents, directory, folders)
    before = read_schema(directory / PREPROCESSOR, PipelineDocument)
    after = read_schema(directory / POSTPROCESSOR, PipelineDocument)
    inputs, outputs = policy.input_features or {}, policy.output_features or {}
    if set(outputs) != {ACTION} or len(outputs[ACTION].shape) != 1:
        raise CheckpointError(
            f"{directory / CONFIG} names the outputs {list_names(outputs) or 'none'}, expected one "
            f"vector {ACTION!r}."
        )
    images, state = _inputs(directory, inputs)
    mapping = policy.normalization_mapping or {}
    _check_statistics(directory, PREPROCESSOR, before, NORMALIZER, inputs, mapping)
    _check_statistics(directory, POSTPROCESSOR, after, UNNORMALIZER, outputs, mapping)
    names, width = policy.action_feature_names or (), outputs[ACTION].shape[0]
    if names and len(names) != width:
        raise CheckpointError(
            f"{directory / CONFIG} names {len(names)} values of {ACTION!r}, which has {width}."
        )
    remembers = (
        policy.n_obs_steps > 1
        or policy.temporal_ensemble_coeff is not None
        or policy.type in ROW_BY_ROW
    )
    if policy.use_relative_actions and remembers:
        raise CheckpointError(
            f"{directory} holds relative actions of a policy that is queried row by row: they "
            "would be added to another state than they were predicted for."
        )
    return PolicyFolder(
        directory=directory,
        family=policy.type,
        images=images,
        state=state,
        action=width,
        names=names,
        rows=1 if remembers else policy.n_action_steps or policy.chunk_size or 1,
        remembers=remembers,
        steps=tuple(step.registry_name for step in before.steps),
        references=references,
    )


def _inputs(
    directory: Path, inputs: Mapping[str, FeatureDocument]
) -> tuple[tuple[ImageFeature, ...], int]:
    """Images, and the width of the state. Raises CheckpointError for inputs no robot provides."""
    images: list[ImageFeature] = []
    state = 0
    for key, feature in inputs.items():
        # the policy fills these itself
        if key.startswith(f"{IMAGES}empty_camera_"):
            continue
        if feature.type == "VISUAL" and len(feature.shape) == 3 and "image" in key:
            _, height, width = feature.shape
            images.append(ImageFeature(key=key, height=height, width=width))
        elif feature.type == "STATE" and key == STATE and len(feature.shape) == 1:
            state = feature.shape[0]
        else:
            raise CheckpointError(
                f"{directory / CONFIG} takes {key!r} ({feature.type}, {list(feature.shape)}), "
                f"which no robot of RoboNeuron has; known are images and {STATE!r}."
            )
    return tuple(images), state


def _check_statistics(
    directory: Path,
    source: str,
    pipeline: PipelineDocument,
    step_name: str,
    features: Mapping[str, FeatureDocument],
    mapping: Mapping[str, str],
) -> None:
    """Raise CheckpointError unless each normalised feature has its statistics.

    LeRobot passes a feature without statistics through unchanged.
    """
    steps = [step for step in pipeline.steps if step.registry_name == step_name]
    asked = {key for key, f in features.items() if mapping.get(f.type, "IDENTITY") != "IDENTITY"}
    if asked and not steps:
        raise CheckpointError(
            f"{directory / source} has no step {step_name!r}, which {list_names(sorted(asked))} "
            "needs.",
            hint=_MIGRATE,
        )
    for step in steps:
        document = check_schema(step.config, TypeAdapter(NormalizerDocument), directory / source)
        known: dict[str, NDArray[np.float64]] = {}
        if step.state_file is not None:
            if Path(step.state_file).name != step.state_file:
                raise CheckpointError(
                    f"{directory / source} names a file outside of its folder: {step.state_file!r}."
                )
            known = read_tensors(directory / step.state_file)
        for key, feature in features.items():
            if key not in document.features:
                mode = mapping.get(feature.type, "IDENTITY")
                if mode != "IDENTITY":
                    raise CheckpointError(
                        f"{directory / source} does not normalise {key!r}, which config.json wants "
                        f"({mode})."
                    )
                continue
            mode = document.norm_map.get(feature.type, "IDENTITY")
            if mode not in _NEEDED:
                raise CheckpointError(
                    f"{directory / source} normalises {key!r} by the unknown mode {mode!r}."
                )
            for statistic in _NEEDED[mode]:
                _check_statistic(
                    known.get(f"{key}.{statistic}"), key, statistic, feature, directory
                )


def _check_statistic(
    values: NDArray[np.float64] | None,
    key: str,
    statistic: str,
    feature: FeatureDocument,
    directory: Path,
) -> None:
    """Raise CheckpointError unless the statistic exists, is finite, and has the width of its
    feature.
    """
    if values is None:
        raise CheckpointError(
            f"{directory} has no statistic {statistic!r} of {key!r}; without it the policy would "
            "get and give numbers of another scale.",
            hint="Save the processors again with the statistics of the training data.",
        )
    expected = feature.shape[0]
    if values.size != expected or not np.isfinite(values).all():
        raise CheckpointError(
            f"{directory} has {values.size} values as {statistic!r} of {key!r}, expected "
            f"{expected} finite ones."
        )
