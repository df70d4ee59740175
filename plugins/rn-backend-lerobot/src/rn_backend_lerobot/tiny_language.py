"""Tiny policies with a language model: SmolVLA, pi0, pi0.5 and X-VLA, with their tokenizers."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Protocol, cast
from unittest import mock

from rn_backend_lerobot.small_gemma import VOCABULARY, small_gemma
from rn_backend_lerobot.tiny_checkpoint import TinyShape, write_policy

TOKENIZER = "tokenizer"
"""Folder of the tokenizer in a checkpoint of pi0, pi05 and xvla."""
BACKBONE = "backbone"
"""Folder of the vision-language model's configuration and processor in a checkpoint of smolvla."""


class _Tokenizer(Protocol):
    def convert_tokens_to_ids(self, token: str) -> int: ...

    def save_pretrained(self, directory: Path) -> None: ...


def write_smolvla(directory: Path, shape: TinyShape) -> None:
    from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    _write_backbone(directory / BACKBONE)
    write_policy(
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
    """Tokenizer with one token per byte, and the special ones."""
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


def write_pi0(directory: Path, shape: TinyShape) -> None:
    from lerobot.policies.pi0 import processor_pi0
    from lerobot.policies.pi0.configuration_pi0 import PI0Config
    from lerobot.policies.pi0.modeling_pi0 import PI0Policy

    with small_gemma(), _local_tokenizer(processor_pi0, directory):
        write_policy(directory, shape, PI0Config, PI0Policy, **_PI)


def write_pi05(directory: Path, shape: TinyShape) -> None:
    from lerobot.policies.pi05 import processor_pi05
    from lerobot.policies.pi05.configuration_pi05 import PI05Config
    from lerobot.policies.pi05.modeling_pi05 import PI05Policy

    with small_gemma(), _local_tokenizer(processor_pi05, directory):
        write_policy(directory, shape, PI05Config, PI05Policy, **_PI)


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
    """Patch the processors to name a tokenizer in the checkpoint's own folder instead of the
    hub's.
    """
    _tokenizer().save_pretrained(directory / TOKENIZER)
    step = processors.TokenizerProcessorStep

    def local(**options: object) -> object:
        return step(**{**options, "tokenizer_name": str(directory / TOKENIZER)})

    with mock.patch.object(processors, "TokenizerProcessorStep", local):
        yield


def write_xvla(directory: Path, shape: TinyShape) -> None:
    from lerobot.configs import NormalizationMode
    from lerobot.policies.xvla.configuration_xvla import XVLAConfig
    from lerobot.policies.xvla.modeling_xvla import XVLAPolicy

    _tokenizer().save_pretrained(directory / TOKENIZER)
    write_policy(
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
        # its default is none: random numbers would be far from those of the arm
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
"""Configuration of Florence-2 with 32 dimensions."""
