"""Run openpi's own pi0.5 on a tiny checkpoint and write down what it computes.

    python openpi_numbers.py OPENPI TINY OUT

OPENPI is a checkout of openpi, TINY the output of `roboneuron-pi0 make-tiny --variant pi05 --layout
openpi --profile droid`, OUT the file for the numbers. It runs in its own environment, which `make
test-parity` sets up: openpi needs transformers 4.53.2 with some of its files replaced. Sizes are
patched on the way, because openpi fixes them; modules that inference does not need (jax, flax and
what downloads things) are replaced by empty ones.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from tokenizers import Tokenizer
from transformers import AutoProcessor, GemmaForCausalLM, PaliGemmaForConditionalGeneration

LOADED = (AutoProcessor, GemmaForCausalLM, PaliGemmaForConditionalGeneration)
"""Imports of openpi from transformers; it looks for jax on import, so they must precede the stub of
jax.
"""
SLOTS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
CELLS = 14
"""Cells along a side of an image; each is 16 x 16 pixels of one colour."""
INSTRUCTIONS = (" put the red_cube\non the plate ", "open the drawer")
PROMPT_LENGTH = 200
CASES = {
    # name: slots with a picture, state (None: not in the prompt), instruction
    "main": ((0, 1), 0, 0),
    "one_camera": ((0,), 0, 0),
    "three_cameras": ((0, 1, 2), 0, 0),
    "other_state": ((0, 1), 1, 0),
    "other_prompt": ((0, 1), 0, 1),
    "no_state": ((0, 1), None, 0),
}


def stub(name: str, **content: object) -> None:
    """Replace the module `name` by one with this content."""
    module = ModuleType(name)
    for key, value in content.items():
        setattr(module, key, value)
    sys.modules[name] = module
    parent, _, leaf = name.rpartition(".")
    if parent in sys.modules:
        setattr(sys.modules[parent], leaf, module)


def prepare(openpi: Path, dims: dict[str, Any]) -> None:
    """Make openpi's PyTorch modules importable, with the checkpoint's gemma sizes."""
    sys.path.insert(0, str(openpi / "src"))
    blocks = {"vlm": dims["vlm_config"]["text_config"], "expert": dims["dit_config"]}
    sizes = {
        name: SimpleNamespace(
            width=block["hidden_size"],
            depth=block["num_hidden_layers"],
            mlp_dim=block["intermediate_size"],
            num_heads=block["num_attention_heads"],
            num_kv_heads=block["num_key_value_heads"],
            head_dim=block["head_dim"],
        )
        for name, block in blocks.items()
    }
    for name in ("jax", "orbax", "orbax.checkpoint", "flax", "openpi_client"):
        stub(name)
    stub("flax.traverse_util")
    stub("openpi_client.image_tools")
    import openpi.models
    import openpi.shared

    stub("openpi.models.gemma", get_config=sizes.__getitem__)
    stub("openpi.models.utils")
    stub("openpi.models.utils.fsq_tokenizer")
    stub("openpi.shared.array_typing", PyTree=dict)
    stub("openpi.shared.download")
    stub("openpi.shared.image_tools")
    stub("openpi.shared.normalize", NormStats=SimpleNamespace)


def build(dims: dict[str, Any], weights: dict[str, torch.Tensor]) -> torch.nn.Module:
    """openpi's model of these sizes, with all of these weights."""
    from openpi.models_pytorch import gemma_pytorch, pi0_pytorch

    vision, vocabulary = (
        dims["vlm_config"]["vision_config"],
        dims["vlm_config"]["text_config"]["vocab_size"],
    )
    paligemma, causal = (
        gemma_pytorch.PaliGemmaForConditionalGeneration,
        gemma_pytorch.GemmaForCausalLM,
    )

    def small_paligemma(config: Any) -> torch.nn.Module:
        for key in (
            "hidden_size",
            "num_hidden_layers",
            "intermediate_size",
            "num_attention_heads",
            "patch_size",
            "image_size",
        ):
            setattr(config.vision_config, key, vision[key])
        config.vision_config.projection_dim = config.text_config.hidden_size
        config.projection_dim = config.text_config.hidden_size
        config.text_config.vocab_size = vocabulary
        config.image_token_index = vocabulary - 1
        return paligemma(config=config)

    def small_causal(config: Any) -> torch.nn.Module:
        config.vocab_size = vocabulary
        return causal(config=config)

    gemma_pytorch.PaliGemmaForConditionalGeneration = small_paligemma
    gemma_pytorch.GemmaForCausalLM = small_causal
    model = pi0_pytorch.PI0Pytorch(
        SimpleNamespace(
            pi05=True,
            paligemma_variant="vlm",
            action_expert_variant="expert",
            dtype="float32",
            action_dim=dims["action_dim"],
            action_horizon=dims["action_horizon"],
            pytorch_compile_mode=None,
        )
    )
    torch.set_float32_matmul_precision("highest")  # openpi sets a lower precision
    missing, unexpected = model.load_state_dict(
        {key: value.float() for key, value in weights.items()}, strict=False
    )
    # The token embedding is tied to the head, which the file holds.
    assert all(key.endswith("embed_tokens.weight") for key in missing), missing
    assert not unexpected, unexpected
    return model.eval()


class TokenizerOfTheCheckpoint:
    """The tiny tokenizer with the interface of SentencePiece that openpi uses."""

    def __init__(self, path: Path) -> None:
        self._tokenizer = Tokenizer.from_file(str(path))

    def encode(self, text: str, *, add_bos: bool = False) -> list[int]:
        start = [self._tokenizer.token_to_id("<bos>")] if add_bos else []
        ids: list[int] = self._tokenizer.encode(text, add_special_tokens=False).ids
        return [*start, *ids]


def main() -> None:
    openpi, tiny, out = (Path(argument) for argument in sys.argv[1:4])
    dims = json.loads((tiny / "config.json").read_text())
    prepare(openpi, dims)
    from openpi import transforms
    from openpi.models import tokenizer as tokenizers

    weights = load_file(tiny / "model.safetensors")
    model = build(dims, weights)
    (stats_file,) = tiny.glob("assets/*/norm_stats.json")
    stats = {
        part: SimpleNamespace(**{key: np.array(value) for key, value in block.items()})
        for part, block in json.loads(stats_file.read_text())["norm_stats"].items()
    }
    normalize = transforms.Normalize(None, use_quantiles=True)
    unnormalize = transforms.Unnormalize(None, use_quantiles=True)
    words = tokenizers.PaligemmaTokenizer.__new__(tokenizers.PaligemmaTokenizer)
    words._max_len = PROMPT_LENGTH
    words._tokenizer = TokenizerOfTheCheckpoint(tiny / "tokenizer.json")

    random = np.random.default_rng(29)
    cells = random.integers(0, 256, (len(SLOTS), CELLS, CELLS, 3), dtype=np.uint8)
    pictures = cells.repeat(16, axis=1).repeat(16, axis=2)
    width = len(stats["state"].q01)
    spread = random.uniform(-1.2, 1.2, (2, width))
    states = stats["state"].mean + spread * (stats["state"].q99 - stats["state"].mean)
    noise = random.standard_normal((dims["action_horizon"], dims["action_dim"])).astype(np.float32)
    numbers: dict[str, np.ndarray] = {"cells": cells, "states": states, "noise": noise}
    numbers["weight"] = weights["action_in_proj.weight"].float().numpy()[0]
    for name, (present, state_index, prompt_index) in CASES.items():
        state = None
        if state_index is not None:
            state = normalize._normalize_quantile(states[state_index], stats["state"])
        tokens, mask = words.tokenize(INSTRUCTIONS[prompt_index], state)
        observation = SimpleNamespace(
            images={
                slot: torch.from_numpy(pictures[i]).permute(2, 0, 1)[None].float() / 255 * 2 - 1
                for i, slot in enumerate(SLOTS)
            },
            image_masks={slot: torch.tensor([i in present]) for i, slot in enumerate(SLOTS)},
            state=torch.zeros(1, dims["action_dim"]),
            tokenized_prompt=torch.from_numpy(tokens.astype(np.int64))[None],
            tokenized_prompt_mask=torch.from_numpy(mask)[None],
            token_ar_mask=None,
            token_loss_mask=None,
        )
        answer = model.sample_actions(
            torch.device("cpu"), observation, noise=torch.from_numpy(noise)[None], num_steps=10
        )[0].numpy()
        actions = unnormalize._unnormalize_quantile(answer.astype(np.float64), stats["actions"])
        numbers[f"{name}/tokens"] = tokens[mask].astype(np.int64)
        numbers[f"{name}/normalized"] = answer
        numbers[f"{name}/actions"] = actions[:, :width]
    np.savez_compressed(out, **numbers)
    print(f"wrote {len(numbers)} arrays to {out}")


if __name__ == "__main__":
    main()
