"""Tiny random checkpoints, written by LeRobot's own classes in its own layout."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Literal, Protocol, cast, get_args
from unittest import mock

from rn_backend_lerobot.isolation import check_release, installed_release
from rn_backend_lerobot.small_gemma import VOCABULARY, small_gemma
from roboneuron import ConfigurationError

Policy = Literal["act", "diffusion", "vqbet", "smolvla", "pi0", "pi05", "xvla"]
POLICIES: tuple[Policy, ...] = get_args(Policy)
PATCHED: tuple[Policy, ...] = ("pi0", "pi05")
"""Those that only `small_gemma` loads."""
TOKENIZER = "tokenizer"
"""Folder of the tokenizer in a checkpoint of pi0, pi05 and xvla."""
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

    _write(
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
        n_action_steps=8,
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


def _write_vqbet(directory: Path, shape: TinyShape) -> None:
    from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
    from lerobot.policies.vqbet.modeling_vqbet import VQBeTPolicy

    def trained(config: object) -> _Saved:
        policy = VQBeTPolicy(config)
        # as after the first phase of the training: LeRobot warns at each action otherwise
        policy.vqbet.action_head.vqvae_model.discretized.fill_(True)
        return cast("_Saved", policy)

    _write(
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


def _write_pi0(directory: Path, shape: TinyShape) -> None:
    from lerobot.policies.pi0 import processor_pi0
    from lerobot.policies.pi0.configuration_pi0 import PI0Config
    from lerobot.policies.pi0.modeling_pi0 import PI0Policy

    with small_gemma(), _local_tokenizer(processor_pi0, directory):
        _write(directory, shape, PI0Config, PI0Policy, **_PI)


def _write_pi05(directory: Path, shape: TinyShape) -> None:
    from lerobot.policies.pi05 import processor_pi05
    from lerobot.policies.pi05.configuration_pi05 import PI05Config
    from lerobot.policies.pi05.modeling_pi05 import PI05Policy

    with small_gemma(), _local_tokenizer(processor_pi05, directory):
        _write(directory, shape, PI05Config, PI05Policy, **_PI)


_PI: dict[str, object] = {
    "chunk_size": 16,
    "n_action_steps": 8,
    "num_inference_steps": 4,
    "max_state_dim": 32,
    "max_action_dim": 32,
    "image_resolution": (64, 64),
    "tokenizer_max_length": 64,
}


@contextlib.contextmanager
def _local_tokenizer(processors: ModuleType, directory: Path) -> Iterator[None]:
    """The processors name a tokenizer in the checkpoint's own folder, not the hub's."""
    _tokenizer().save_pretrained(directory / TOKENIZER)
    step = processors.TokenizerProcessorStep

    def local(**options: object) -> object:
        return step(**{**options, "tokenizer_name": str(directory / TOKENIZER)})

    with mock.patch.object(processors, "TokenizerProcessorStep", local):
        yield


def _write_xvla(directory: Path, shape: TinyShape) -> None:
    from lerobot.configs import NormalizationMode
    from lerobot.policies.xvla.configuration_xvla import XVLAConfig
    from lerobot.policies.xvla.modeling_xvla import XVLAPolicy

    _tokenizer().save_pretrained(directory / TOKENIZER)
    _write(
        directory,
        shape,
        XVLAConfig,
        XVLAPolicy,
        chunk_size=16,
        n_action_steps=8,
        florence_config=_FLORENCE,
        tokenizer_name=str(directory / TOKENIZER),
        tokenizer_max_length=32,
        hidden_size=32,
        depth=1,
        num_heads=2,
        num_domains=2,
        len_soft_prompts=4,
        action_mode="auto",
        num_denoising_steps=2,
        resize_imgs_with_padding=(64, 64),
        # its default is none: random numbers would be far from the arm's
        normalization_mapping={
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        },
    )


_FLORENCE: dict[str, object] = {
    "vision_config": {
        "embed_dim": [16, 16, 32, 32],
        "depths": [1, 1, 1, 1],
        "num_heads": [1, 1, 2, 2],
        "num_groups": [1, 1, 2, 2],
        "window_size": 4,
        "projection_dim": 32,
    },
    "text_config": {
        "vocab_size": VOCABULARY,
        "d_model": 32,
        "encoder_layers": 1,
        "decoder_layers": 1,
        "encoder_attention_heads": 2,
        "decoder_attention_heads": 2,
        "encoder_ffn_dim": 64,
        "decoder_ffn_dim": 64,
        "max_position_embeddings": 256,
    },
}
"""Florence-2 with 32 dimensions."""
_WRITERS: dict[Policy, Callable[[Path, TinyShape], None]] = {
    "act": _write_act,
    "diffusion": _write_diffusion,
    "vqbet": _write_vqbet,
    "smolvla": _write_smolvla,
    "pi0": _write_pi0,
    "pi05": _write_pi05,
    "xvla": _write_xvla,
}
