"""Tiny random checkpoints of zero-shot detectors in the public layouts of the library transformers,
which load and run like real ones and find nothing that is there.

python -m rn_locator_transformers.tiny owlv2 FOLDER
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from string import ascii_lowercase
from typing import Any

from roboneuron import ConfigurationError

_WIDTH, _SIDE_PX = 32, 96
_WORDS = ["a", "red", "green", "blue", "cube", "mug", "cup", "of", "tea", "thing"]


def make_tiny(folder: Path, family: str, *, seed: int = 0) -> None:
    """Write a checkpoint into a new folder.

    Args:
        folder: destination.
        family: a key of `FAMILIES`.
        seed: of the random weights.

    Raises:
        ConfigurationError: the folder exists.
    """
    import torch
    import transformers

    library: Any = transformers  # most of it has no types
    library.utils.logging.disable_progress_bar()

    if folder.exists():
        raise ConfigurationError(f"{folder} exists.", hint="Name a new folder.")
    folder.mkdir(parents=True)
    torch.manual_seed(seed)
    for part in FAMILIES[family](library):
        part.save_pretrained(folder)


def _owlv2(library: Any) -> tuple[Any, ...]:
    letters = [*ascii_lowercase, *(f"{letter}</w>" for letter in ascii_lowercase)]
    names = ["!", *letters, "<|startoftext|>", "<|endoftext|>"]
    vocabulary = {name: number for number, name in enumerate(names)}
    layers = {
        "hidden_size": _WIDTH,
        "intermediate_size": 2 * _WIDTH,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
    }
    config = library.Owlv2Config(
        text_config={
            **layers,
            "vocab_size": len(names),
            "max_position_embeddings": 16,
            "pad_token_id": 0,
            "bos_token_id": vocabulary["<|startoftext|>"],
            "eos_token_id": vocabulary["<|endoftext|>"],
        },
        vision_config={**layers, "image_size": _SIDE_PX, "patch_size": 16},
        projection_dim=_WIDTH,
    )
    return (
        library.Owlv2ForObjectDetection(config),
        library.CLIPTokenizer(vocab=vocabulary, merges=[], pad_token="!", model_max_length=16),
        library.Owlv2ImageProcessorPil(size={"height": _SIDE_PX, "width": _SIDE_PX}),
    )


def _grounding_dino(library: Any) -> tuple[Any, ...]:
    special = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "?", "!"]
    letters = [*ascii_lowercase[1:], *(f"##{letter}" for letter in ascii_lowercase)]
    names = [*special, *_WORDS, *letters]
    backbone = library.SwinConfig(
        image_size=_SIDE_PX,
        embed_dim=8,
        depths=[1, 1, 1, 1],
        num_heads=[1, 1, 1, 1],
        window_size=4,
        out_indices=[2, 3, 4],
    )
    text = library.BertConfig(
        vocab_size=len(names),
        hidden_size=_WIDTH,
        num_hidden_layers=1,
        num_attention_heads=2,
        intermediate_size=2 * _WIDTH,
        max_position_embeddings=256,
    )
    config = library.GroundingDinoConfig(
        backbone_config=backbone.to_dict(),
        text_config=text.to_dict(),
        d_model=_WIDTH,
        encoder_layers=1,
        decoder_layers=2,
        encoder_ffn_dim=2 * _WIDTH,
        decoder_ffn_dim=2 * _WIDTH,
        encoder_attention_heads=2,
        decoder_attention_heads=2,
        num_queries=12,
    )
    return (
        library.GroundingDinoForObjectDetection(config),
        library.BertTokenizer(vocab={name: number for number, name in enumerate(names)}),
        library.GroundingDinoImageProcessorPil(
            size={"shortest_edge": _SIDE_PX, "longest_edge": 2 * _SIDE_PX}
        ),
    )


FAMILIES: Mapping[str, Callable[[Any], tuple[Any, ...]]] = {
    "owlv2": _owlv2,
    "grounding-dino": _grounding_dino,
}
"""What makes model, tokenizer and image processor, given the library, by the family's name."""


def main() -> None:
    """Write the checkpoint that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("family", choices=FAMILIES)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    make_tiny(arguments.folder, arguments.family, seed=arguments.seed)


if __name__ == "__main__":
    main()
