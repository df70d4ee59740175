"""Tiny random checkpoints, written by LeRobot's own classes in its own layout."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, cast, get_args
from unittest import mock

from rn_backend_lerobot.isolation import check_release, installed_release
from rn_backend_lerobot.small_gemma import VOCABULARY, small_gemma
from roboneuron import ConfigurationError

Policy = Literal["act", "diffusion", "smolvla", "pi05"]
POLICIES: tuple[Policy, ...] = get_args(Policy)
TOKENIZER = "tokenizer"
"""Folder of the tokenizer in a checkpoint of pi05."""
BACKBONE = "backbone"
"""Folder of the vision-language model's configuration and processor in one of smolvla."""
HOME = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785, 0.5)
"""Mean of states and actions: seven joints [rad] of an arm, and a gripper [opening]."""
SPREAD = 0.05
"""Standard deviation of both: what a random policy moves about."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TinyShape:
    """What a tiny policy takes and gives.

    Attributes:
        cameras: short names of its image features.
        width, height: of the images [px].
        means: of each value of state and action, in the units of the training data.
    """

    cameras: Sequence[str] = ("front", "wrist")
    width: int = 96
    height: int = 96
    means: Sequence[float] = HOME


class _Tokenizer(Protocol):
    def convert_tokens_to_ids(self, token: str) -> int: ...

    def save_pretrained(self, directory: Path) -> None: ...


class _Saved(Protocol):
    def save_pretrained(self, directory: Path) -> None: ...


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


def _features(shape: TinyShape) -> tuple[dict[str, object], dict[str, object]]:
    """Inputs and outputs as LeRobot's configurations take them."""
    from lerobot.configs import FeatureType, PolicyFeature

    size = len(shape.means)
    image = (3, shape.height, shape.width)
    images = {
        f"observation.images.{name}": PolicyFeature(type=FeatureType.VISUAL, shape=image)
        for name in shape.cameras
    }
    state = PolicyFeature(type=FeatureType.STATE, shape=(size,))
    action = PolicyFeature(type=FeatureType.ACTION, shape=(size,))
    return {**images, "observation.state": state}, {"action": action}


def _statistics(shape: TinyShape) -> dict[str, dict[str, object]]:
    """Of a data set about `shape.means`; images as ImageNet has them."""
    import torch

    mean = torch.tensor(shape.means, dtype=torch.float32)
    values: dict[str, object] = {
        "mean": mean,
        "std": torch.full_like(mean, SPREAD),
        "min": mean - 2.0 * SPREAD,
        "max": mean + 2.0 * SPREAD,
        "q01": mean - 2.0 * SPREAD,
        "q99": mean + 2.0 * SPREAD,
    }
    image: dict[str, object] = {
        "mean": torch.tensor([0.485, 0.456, 0.406]).reshape(3, 1, 1),
        "std": torch.tensor([0.229, 0.224, 0.225]).reshape(3, 1, 1),
        "min": torch.zeros(3, 1, 1),
        "max": torch.ones(3, 1, 1),
    }
    images = {f"observation.images.{name}": image for name in shape.cameras}
    return {**images, "observation.state": values, "action": values}


def _write(
    directory: Path,
    shape: TinyShape,
    configure: Callable[..., object],
    policy: Callable[[object], _Saved],
    **settings: object,
) -> None:
    """Save a policy of random weights with its processors.

    Args:
        directory: where to.
        shape: what it takes and gives.
        configure, policy: LeRobot's classes of its configuration and of itself.
        settings: of its configuration, beside those of every policy here.
    """
    from lerobot.policies.factory import make_pre_post_processors

    inputs, outputs = _features(shape)
    config = configure(
        input_features=inputs,
        output_features=outputs,
        device="cpu",
        n_action_steps=8,
        **settings,
    )
    before, after = make_pre_post_processors(config, dataset_stats=_statistics(shape))
    for part in (policy(config), before, after):
        part.save_pretrained(directory)


def _write_act(directory: Path, shape: TinyShape) -> None:
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    _write(
        directory,
        shape,
        ACTConfig,
        ACTPolicy,
        chunk_size=16,
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

    _write(
        directory,
        shape,
        DiffusionConfig,
        DiffusionPolicy,
        n_obs_steps=2,
        horizon=16,
        down_dims=(32, 64),
        diffusion_step_embed_dim=16,
        spatial_softmax_num_keypoints=8,
        noise_scheduler_type="DDIM",
        num_inference_steps=2,
        pretrained_backbone_weights=None,
    )


def _write_smolvla(directory: Path, shape: TinyShape) -> None:
    from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    _write_backbone(directory / BACKBONE)
    _write(
        directory,
        shape,
        SmolVLAConfig,
        SmolVLAPolicy,
        chunk_size=16,
        num_steps=4,
        num_vlm_layers=2,
        expert_width_multiplier=0.5,
        resize_imgs_with_padding=(64, 64),
        vlm_model_name=str(directory / BACKBONE),
        load_vlm_weights=False,
    )


def _write_backbone(directory: Path) -> None:
    """Configuration and processor of a SmolVLM of 64 dimensions."""
    from transformers import (
        SmolVLMConfig,
        SmolVLMImageProcessor,
        SmolVLMProcessor,
        SmolVLMVideoProcessor,
    )

    tokenizer = _tokenizer(
        fake_image_token="<fake_token_around_image>",
        image_token="<image>",
        global_image_token="<global-img>",
        end_of_utterance_token="<end_of_utterance>",
        video_token="<video>",
    )
    config = SmolVLMConfig.from_dict(
        {
            "text_config": {
                "model_type": "llama",
                "hidden_size": 64,
                "intermediate_size": 128,
                "num_hidden_layers": 2,
                "num_attention_heads": 2,
                "num_key_value_heads": 1,
                "head_dim": 32,
                "vocab_size": VOCABULARY,
                "pad_token_id": 0,
            },
            "vision_config": {
                "hidden_size": 32,
                "intermediate_size": 64,
                "num_hidden_layers": 1,
                "num_attention_heads": 2,
                "image_size": 64,
                "patch_size": 16,
            },
            "image_token_id": tokenizer.convert_tokens_to_ids("<image>"),
            "pad_token_id": 0,
            "scale_factor": 2,
        }
    )
    config.save_pretrained(directory)
    processor = SmolVLMProcessor(
        image_processor=SmolVLMImageProcessor(),
        tokenizer=tokenizer,
        video_processor=SmolVLMVideoProcessor(),
    )
    processor.save_pretrained(directory)


def _tokenizer(**special: str) -> _Tokenizer:
    """One token for each byte, and the special ones."""
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    named = {"pad_token": "<pad>", "bos_token": "<bos>", "eos_token": "<eos>", "unk_token": "<unk>"}
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {token: i for i, token in enumerate([*named.values(), *alphabet])}
    tokenizer = Tokenizer(models.BPE(vocab=vocabulary, merges=[], unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    make = cast("Callable[..., _Tokenizer]", PreTrainedTokenizerFast)
    return make(tokenizer_object=tokenizer, **named, extra_special_tokens=special)


def _write_pi05(directory: Path, shape: TinyShape) -> None:
    from lerobot.policies.pi05 import processor_pi05
    from lerobot.policies.pi05.configuration_pi05 import PI05Config
    from lerobot.policies.pi05.modeling_pi05 import PI05Policy

    _tokenizer().save_pretrained(directory / TOKENIZER)
    step = processor_pi05.TokenizerProcessorStep

    def local(**options: object) -> object:
        return step(**{**options, "tokenizer_name": str(directory / TOKENIZER)})

    with small_gemma(), mock.patch.object(processor_pi05, "TokenizerProcessorStep", local):
        _write(
            directory,
            shape,
            PI05Config,
            PI05Policy,
            chunk_size=16,
            num_inference_steps=4,
            max_state_dim=32,
            max_action_dim=32,
            image_resolution=(64, 64),
            tokenizer_max_length=64,
        )


_WRITERS: dict[Policy, Callable[[Path, TinyShape], None]] = {
    "act": _write_act,
    "diffusion": _write_diffusion,
    "smolvla": _write_smolvla,
    "pi05": _write_pi05,
}
