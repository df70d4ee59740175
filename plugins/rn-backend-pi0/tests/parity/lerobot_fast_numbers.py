"""Run LeRobot's own pi0-FAST on a tiny checkpoint and write down what it computes.

    python lerobot_fast_numbers.py LEROBOT TINY OUT

LEROBOT is a checkout of lerobot, TINY what `roboneuron-pi0 make-tiny --variant pi0_fast --profile
droid` wrote, OUT the file for the numbers. It runs in its own environment with transformers
5.5.4, which `make test-parity` sets up. Sizes are patched on the way, because LeRobot fixes them;
packages whose `__init__` imports everything are replaced by empty ones.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import torch
from safetensors.torch import load_file
from scipy.fft import dct
from transformers import PreTrainedTokenizerFast

SLOTS, CELLS = 3, 14
"""Camera slots, and cells along a side of an image: 16 x 16 pixels of one colour each."""
STEPS = 24
PROMPT_LENGTH = 200
CASES = {
    # name: slots with a picture, prompt
    "main": ((0, 1), 0),
    "one_camera": ((0,), 0),
    "other_prompt": ((0, 1), 1),
}
PROMPTS = (
    "Task: put the red cube on the plate, State: 3 120 255 -1 99;\n",
    "Task: open the drawer, State: 0 1 2 3 4 5;\n",
)


def stub(name: str, path: Path | None = None, **content: object) -> None:
    """Replace the module `name` by one with this content; with `path` it may have submodules."""
    module = ModuleType(name)
    if path is not None:
        module.__path__ = [str(path)]
    for key, value in content.items():
        setattr(module, key, value)
    sys.modules[name] = module


def load_modules(lerobot: Path) -> Any:
    """LeRobot's module of pi0-FAST."""
    root = lerobot / "src" / "lerobot"
    for name in ("", ".utils", ".policies", ".policies.common", ".policies.pi0_fast"):
        stub(f"lerobot{name}", root / name[1:].replace(".", "/"))
    stub("lerobot.configs", PreTrainedConfig=SimpleNamespace)
    stub("lerobot.policies.pretrained", PreTrainedPolicy=torch.nn.Module, T=TypeVar("T"))
    stub("lerobot.policies.rtc")
    stub("lerobot.policies.rtc.modeling_rtc", RTCProcessor=SimpleNamespace)
    stub("lerobot.policies.pi0_fast.configuration_pi0_fast", PI0FastConfig=SimpleNamespace)
    import lerobot.policies.pi0_fast.modeling_pi0_fast as module

    return module


def build(module: Any, dims: dict[str, Any], weights: dict[str, torch.Tensor], words: Any) -> Any:
    """LeRobot's model of these sizes, with all of these weights."""
    text, vision = dims["vlm_config"]["text_config"], dims["vlm_config"]["vision_config"]
    size = module.GemmaConfig(
        width=text["hidden_size"],
        depth=text["num_hidden_layers"],
        mlp_dim=text["intermediate_size"],
        num_heads=text["num_attention_heads"],
        num_kv_heads=text["num_key_value_heads"],
        head_dim=text["head_dim"],
    )
    paligemma = module.PaliGemmaForConditionalGenerationWithPiGemma

    def small(config: Any) -> torch.nn.Module:
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
        config.text_config.vocab_size = text["vocab_size"]
        config.image_token_index = text["vocab_size"] - 1
        return paligemma(config=config)

    module.get_gemma_config = lambda variant: size
    module.PaliGemmaForConditionalGenerationWithPiGemma = small
    config = SimpleNamespace(
        paligemma_variant="gemma_2b",
        dtype="float32",
        compile_model=False,
        max_action_tokens=STEPS,
        fast_skip_tokens=dims["fast_skip_tokens"],
        validate_action_token_prefix=False,
    )
    model = module.PI0FastPytorch(config, paligemma_tokenizer=words)
    plain = {key.removeprefix("model."): value.float() for key, value in weights.items()}
    missing, unexpected = model.load_state_dict(plain, strict=False)
    # The token embedding is tied to the head, which the file holds.
    assert all(key.endswith("embed_tokens.weight") for key in missing), missing
    assert not unexpected, unexpected
    head = model.paligemma_with_expert.paligemma.lm_head.weight
    model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight = head
    return model.eval()


def main() -> None:
    lerobot, tiny, out = (Path(argument) for argument in sys.argv[1:4])
    dims = json.loads((tiny / "config.json").read_text())
    words = PreTrainedTokenizerFast(tokenizer_file=str(tiny / "tokenizer.json"), bos_token="<bos>")
    module = load_modules(lerobot)
    weights = load_file(tiny / "model.safetensors")
    model = build(module, dims, weights, words)
    random = np.random.default_rng(31)
    cells = random.integers(0, 256, (SLOTS, CELLS, CELLS, 3), dtype=np.uint8)
    pictures = torch.from_numpy(cells.repeat(16, axis=1).repeat(16, axis=2)).permute(0, 3, 1, 2)
    pixels = pictures.float() / 255 * 2 - 1
    numbers: dict[str, np.ndarray] = {"cells": cells}
    numbers["weight"] = next(v for k, v in weights.items() if k.endswith("fc1.weight")).float()[0]
    for name, (present, prompt) in CASES.items():
        ids = [words.bos_token_id, *words.encode(PROMPTS[prompt], add_special_tokens=False)]
        tokens = torch.zeros((1, PROMPT_LENGTH), dtype=torch.long)
        tokens[0, : len(ids)] = torch.tensor(ids)
        answer = model.sample_actions_fast_kv_cache(
            [pixels[i : i + 1] for i in range(SLOTS)],
            [torch.tensor([i in present]) for i in range(SLOTS)],
            tokens,
            torch.arange(PROMPT_LENGTH)[None] < len(ids),
            max_decoding_steps=STEPS,
        )
        numbers[f"{name}/prompt"] = np.array([*ids, words.bos_token_id])
        numbers[f"{name}/tokens"] = answer[0].numpy()
    directory = tiny / "action_tokenizer"
    processor = json.loads((directory / "processor_config.json").read_text())
    fast = SimpleNamespace(
        bpe_tokenizer=PreTrainedTokenizerFast(
            tokenizer_file=str(directory / "tokenizer.json"), clean_up_tokenization_spaces=False
        ),
        min_token=processor["min_token"],
        scale=processor["scale"],
    )
    policy = SimpleNamespace(action_tokenizer=fast, _paligemma_tokenizer=words, config=model.config)
    for method in ("decode_actions_with_fast", "_paligemma_tokens_to_act_tokens"):
        setattr(policy, method, getattr(module.PI0FastPolicy, method).__get__(policy))
    shape = (processor["time_horizon"], processor["action_dim"])
    for name, cut in (("whole", 0), ("short", 2)):
        chunk = random.normal(0, 0.2, shape).cumsum(axis=0).clip(-1, 1)
        spelled = np.around(dct(chunk, axis=0, norm="ortho") * fast.scale) - fast.min_token
        text = "".join(chr(int(value)) for value in spelled.flatten())
        codes = fast.bpe_tokenizer.encode(text, add_special_tokens=False)
        codes = codes[: len(codes) - cut]
        last = words.vocab_size - 1 - model.config.fast_skip_tokens
        ids = [last - code for code in codes]
        numbers[f"{name}/ids"] = np.array(ids)
        given = [*words.encode("Action: ", add_special_tokens=False), *ids]
        sequence = torch.tensor([*given, words.convert_tokens_to_ids("|")])
        actions = module.PI0FastPolicy.detokenize_actions(policy, sequence, *shape)
        numbers[f"{name}/actions"] = actions.numpy()
        numbers[f"{name}/chunk"] = chunk
    np.savez_compressed(out, **numbers)
    print(f"wrote {len(numbers)} arrays to {out}")


if __name__ == "__main__":
    main()
