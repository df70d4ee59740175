"""Loading of a policy and its processors with LeRobot's own factory, from local files only."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

from rn_backend_lerobot.checkpoint import PREPROCESSOR, PolicyFolder
from rn_backend_lerobot.isolation import (
    LoadsWeights,
    check_release,
    installed_release,
    whole_weights,
)
from rn_vla.checkpoint_files import clip, reading
from roboneuron import CheckpointError, MissingDependencyError

if TYPE_CHECKING:
    import torch

_DEVICE, _RENAME = "device_processor", "rename_observations_processor"
_TOKENIZER = "tokenizer_processor"


class PolicyConfig(Protocol):
    """The attributes used of a policy's configuration."""

    device: str
    use_amp: bool
    rtc_config: object


class LeRobotPolicy(Protocol):
    """The attributes and methods used of a policy."""

    config: PolicyConfig

    def predict_action_chunk(
        self, batch: Mapping[str, object], **options: object
    ) -> torch.Tensor: ...

    def select_action(self, batch: Mapping[str, object]) -> torch.Tensor: ...

    def reset(self) -> None: ...


class Pipeline(Protocol):
    """The attributes and methods used of a processor."""

    steps: Sequence[object]

    def __call__(self, data: object) -> object: ...

    def reset(self) -> None: ...


class _PolicyClass(LoadsWeights, Protocol):
    def from_pretrained(self, directory: str, *, config: object, strict: bool) -> LeRobotPolicy: ...


def load_policy(folder: PolicyFolder, device: str) -> tuple[LeRobotPolicy, Pipeline, Pipeline]:
    """Load the policy to its device, with its preprocessor and postprocessor as LeRobot creates
    them.

    Raises:
        CheckpointError: LeRobot cannot load it, or its weights do not fit.
        MissingDependencyError: LeRobot is missing, of another release, or lacks an extra.
    """
    check_release(installed_release())
    directory = str(folder.directory)
    with reading(folder.directory, f"a LeRobot policy {folder.family!r}"):
        from lerobot.configs import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors
        from lerobot.utils.import_utils import register_third_party_plugins

        if folder.family not in PreTrainedConfig.get_known_choices():
            register_third_party_plugins()
        if folder.family not in PreTrainedConfig.get_known_choices():
            raise CheckpointError(
                f"{directory} holds a policy {clip(folder.family)!r}, which LeRobot "
                f"{installed_release()} does not know.",
                hint=f"Install the package that provides it (lerobot_policy_...) in {sys.prefix}.",
            )
        config = PreTrainedConfig.from_pretrained(directory, local_files_only=True)
        config.device = device
        _localise(config, folder)
        kind = _policy_class(get_policy_class, folder.family)
        with whole_weights(kind, directory):
            # extra weights do no harm; missing ones are detected by `whole_weights`
            policy = kind.from_pretrained(directory, config=config, strict=False)
        overrides = _overrides(folder, device)
        before, after = make_pre_post_processors(
            config, directory, preprocessor_overrides=overrides
        )
    return policy, before, after


def _localise(config: object, folder: PolicyFolder) -> None:
    """Replace names of the hub by local folders in the configuration, and do not fetch ImageNet
    weights, which the checkpoint would overwrite anyway.
    """
    for key, value in vars(config).items():
        if isinstance(value, str) and value in folder.references:
            setattr(config, key, str(folder.references[value]))
    if hasattr(config, "pretrained_backbone_weights"):
        config.pretrained_backbone_weights = None


def _overrides(folder: PolicyFolder, device: str) -> dict[str, dict[str, object]]:
    """Overrides for the preprocessor's steps."""
    overrides: dict[str, dict[str, object]] = {}
    document = json.loads((folder.directory / PREPROCESSOR).read_text(encoding="utf-8"))
    for step in document["steps"]:
        name, config = step.get("registry_name"), step.get("config", {})
        if name == _DEVICE:
            overrides[_DEVICE] = {"device": device}
        elif name == _RENAME:
            overrides[_RENAME] = {"rename_map": {}}
        elif name == _TOKENIZER and config.get("tokenizer_name") in folder.references:
            local = folder.references[config["tokenizer_name"]]
            overrides[_TOKENIZER] = {"tokenizer_name": str(local)}
    return overrides


def _policy_class(get: Callable[[str], _PolicyClass], family: str) -> _PolicyClass:
    """The class of a policy. Raises MissingDependencyError if LeRobot's extra for it is missing."""
    try:
        return get(family)
    except ImportError as error:
        raise MissingDependencyError(
            f"LeRobot's policy {family!r} cannot be imported in {sys.prefix}: {clip(error)}",
            hint=f'Run there: pip install "lerobot[{family}]"',
        ) from error
