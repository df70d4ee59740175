"""Conversion of packed flow weights to a folder in LeRobot's layout of pi0, which rn-backend-pi0
loads like any other.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from rn_policy_cubes.checkpoint import CONFIGURATION_FILE, toml_lines
from rn_policy_cubes.flow.measure import EULER_STEPS
from rn_policy_cubes.flow.network import CubesFlowNetwork
from rn_policy_cubes.flow.packing import FlowPacked
from rn_policy_cubes.flow.recipe import (
    ACTION_MEAN,
    ACTION_STD,
    FLOW_ROWS,
    STATE_MEAN,
    STATE_STD,
    FlowShape,
)
from rn_policy_cubes.flow.words import write_flow_tokenizer
from rn_policy_cubes.recipe import ACTION_WIDTH, GRID, PATCH_PX, STATE_WIDTH
from rn_policy_cubes.teacher import STEP_S
from roboneuron import ConfigurationError
from roboneuron.feature import reading

FLOW_BACKEND = "pi0"
FLOW_OPTIONS: Mapping[str, object] = {"profile": "own", "cpu_threads": 1}
FLOW_STATE: Mapping[str, object] = {"terms": ["position", "rpy_by_down", "gripper_open"]}
FLOW_ACTION: Mapping[str, object] = {
    "meaning": "delta",
    "frame": "base",
    "rotation": "rotvec",
    "gripper": "open_fraction",
    "step_s": STEP_S,
}
"""Options of the backend for which the weights were trained, without `checkpoint`."""
_SIDE_PX = GRID * PATCH_PX
_PALIGEMMA = "model.paligemma_with_expert.paligemma."
_VISION = _PALIGEMMA + "model.vision_tower.vision_model."
_PREFIX = _PALIGEMMA + "model.language_model."
_EXPERT = "model.paligemma_with_expert.gemma_expert.model."
_PLAIN = {
    "pos_embed": _VISION + "embeddings.position_embedding.weight",
    "embed": _PALIGEMMA + "lm_head.weight",
    "expert_norm": _EXPERT + "norm.weight",
}
_LINEAR = {
    "post_norm": _VISION + "post_layernorm",
    "projector": _PALIGEMMA + "model.multi_modal_projector.linear",
    "state_proj": "model.state_proj",
    "action_in": "model.action_in_proj",
    "action_out": "model.action_out_proj",
    "time_in": "model.action_time_mlp_in",
    "time_out": "model.action_time_mlp_out",
}
_OF_BLOCK = {
    "proj": "self_attn.out_proj",
    "norm1": "layer_norm1",
    "norm2": "layer_norm2",
    "fc1": "mlp.fc1",
    "fc2": "mlp.fc2",
}
_OF_LAYER: Mapping[str, Sequence[str]] = {
    "norm_in": ("input_layernorm.weight",),
    "norm_post": ("post_attention_layernorm.weight",),
    "kv.weight": ("self_attn.k_proj.weight", "self_attn.v_proj.weight"),
    "query.weight": ("self_attn.q_proj.weight",),
    "out.weight": ("self_attn.o_proj.weight",),
    "gate_up.weight": ("mlp.gate_proj.weight", "mlp.up_proj.weight"),
    "down.weight": ("mlp.down_proj.weight",),
}


def unpack_flow(packed: FlowPacked, directory: Path) -> None:
    """Write config.json, weights, tokenizer and processors with their statistics into a new or
    empty folder; and a roboneuron.toml that runs this checkpoint on the simulated robot.

    Raises:
        ConfigurationError: the folder is not empty.
    """
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise ConfigurationError(
            f"{directory} exists and is not an empty directory.", hint="Name a new directory."
        )
    directory.mkdir(parents=True, exist_ok=True)
    shape = packed.card.recipe.shape
    write_flow_tokenizer(directory / "tokenizer.json")
    tensors = flow_tensors(packed.network())
    save_file(tensors, directory / "model.safetensors", metadata={"format": "pt"})
    _write_processors(directory, shape, packed.card.vocabulary)
    configuration = flow_configuration(directory)
    (directory / CONFIGURATION_FILE).write_text(configuration, encoding="utf-8")


def flow_configuration(directory: Path) -> str:
    """The embedded default configuration with this checkpoint as the policy, as TOML."""
    chosen = f"backend = {json.dumps(FLOW_BACKEND)}"
    lines = [reading.default_text().replace('backend = "servo"', chosen)]
    options = {"checkpoint": str(directory.resolve()), **FLOW_OPTIONS}
    table = f"plugins.{FLOW_BACKEND}"
    for name, values in (
        (table, options),
        (f"{table}.state", FLOW_STATE),
        (f"{table}.action", FLOW_ACTION),
    ):
        lines += [f"[{name}]", *toml_lines(values), ""]
    return "\n".join(lines)


def flow_tensors(network: CubesFlowNetwork) -> dict[str, Tensor]:
    """Every tensor of the public layout, float32. Those that inference never reads are zero: the
    language model's last norm, and its last layer but for keys and values.
    """
    tensors: dict[str, Tensor] = {}
    for name, value in network.state_dict().items():
        for public, part in _flow_public(name, value.detach().float().cpu(), network.shape):
            tensors[public] = part.contiguous().clone()
    shape, last = network.shape, f"{_PREFIX}layers.{network.shape.layers - 1}."
    first = f"{_PREFIX}layers.0."
    for name in [name for name in tensors if name.startswith(first)]:
        unread = last + name.removeprefix(first)
        tensors.setdefault(unread, torch.zeros_like(tensors[name]))
    tensors[_PREFIX + "norm.weight"] = torch.zeros(shape.hidden)
    return tensors


def _flow_public(name: str, value: Tensor, shape: FlowShape) -> list[tuple[str, Tensor]]:
    """Public names and values of one parameter."""
    if name in _PLAIN:
        return [(_PLAIN[name], value)]
    if name == "patch.weight":
        name, value = "patch.weight", value.view(len(value), 3, PATCH_PX, PATCH_PX)
    if name.startswith("patch."):
        return [(_VISION + name.replace("patch.", "embeddings.patch_embedding."), value)]
    if found := re.fullmatch(r"blocks\.(\d+)\.(\w+)\.(\w+)", name):
        base = f"{_VISION}encoder.layers.{found[1]}."
        if found[2] == "qkv":
            names = [f"{base}self_attn.{part}_proj.{found[3]}" for part in "qkv"]
            return list(zip(names, value.chunk(3), strict=True))
        return [(f"{base}{_OF_BLOCK[found[2]]}.{found[3]}", value)]
    if found := re.fullmatch(r"(layers\.\d+|last\.layer|expert\.\d+)\.(.+)", name):
        kind, _, number = found[1].partition(".")
        base = _EXPERT if kind == "expert" else _PREFIX
        index = str(shape.layers - 1) if kind == "last" else number
        names = [f"{base}layers.{index}.{part}" for part in _OF_LAYER[found[2]]]
        return list(zip(names, value.chunk(len(names)), strict=True))
    module, _, leaf = name.rpartition(".")
    return [(f"{_LINEAR[module]}.{leaf}", value)]


def _write_processors(directory: Path, shape: FlowShape, vocabulary: int) -> None:
    """config.json, and the two pipelines with their statistics."""
    norms = {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}
    inputs: dict[str, object] = {
        "observation.images.base_0_rgb": {"type": "VISUAL", "shape": [3, _SIDE_PX, _SIDE_PX]},
        "observation.state": {"type": "STATE", "shape": [STATE_WIDTH]},
    }
    outputs: dict[str, object] = {"action": {"type": "ACTION", "shape": [ACTION_WIDTH]}}
    config = {
        "type": "pi0",
        "input_features": inputs,
        "output_features": outputs,
        "normalization_mapping": norms,
        "chunk_size": FLOW_ROWS,
        "n_action_steps": FLOW_ROWS,
        "max_state_dim": STATE_WIDTH,
        "max_action_dim": ACTION_WIDTH,
        "num_inference_steps": EULER_STEPS,
        "image_resolution": [_SIDE_PX, _SIDE_PX],
        "empty_cameras": 0,
        "tokenizer_max_length": 48,
        "min_period": shape.min_period,
        "max_period": shape.max_period,
        **_dimensions(shape, vocabulary),
    }
    _write_json(directory / "config.json", config)
    statistics = {
        "observation.state.mean": STATE_MEAN,
        "observation.state.std": STATE_STD,
        "action.mean": ACTION_MEAN,
        "action.std": ACTION_STD,
    }
    tensors = {name: torch.tensor(values) for name, values in statistics.items()}
    for stage, kind, position in (("pre", "normalizer", 5), ("post", "unnormalizer", 0)):
        file = f"policy_{stage}processor_step_{position}_{kind}_processor.safetensors"
        save_file(tensors, directory / file)
        step = {
            "registry_name": f"{kind}_processor",
            "config": {"eps": 1e-8, "features": inputs | outputs, "norm_map": norms},
            "state_file": file,
        }
        document = {"name": f"policy_{stage}processor", "steps": [step]}
        _write_json(directory / f"policy_{stage}processor.json", document)


def _dimensions(shape: FlowShape, vocabulary: int) -> Mapping[str, object]:
    vision = {
        "model_type": "siglip_vision_model",
        "hidden_size": shape.vision_width,
        "num_hidden_layers": shape.vision_depth,
        "intermediate_size": shape.vision_inner,
        "num_attention_heads": shape.vision_heads,
        "patch_size": PATCH_PX,
        "image_size": _SIDE_PX,
        "hidden_act": "gelu_pytorch_tanh",
        "layer_norm_eps": 1e-6,
    }
    language = _gemma(shape, vocabulary, shape.hidden, shape.intermediate)
    return {
        "vlm_config": {
            "model_type": "paligemma",
            "projection_dim": shape.hidden,
            "text_config": language,
            "vision_config": vision,
        },
        "dit_config": _gemma(shape, vocabulary, shape.expert, shape.expert_intermediate),
    }


def _gemma(shape: FlowShape, vocabulary: int, width: int, inner: int) -> Mapping[str, object]:
    return {
        "model_type": "gemma",
        "vocab_size": vocabulary,
        "hidden_size": width,
        "num_hidden_layers": shape.layers,
        "intermediate_size": inner,
        "num_attention_heads": shape.heads,
        "num_key_value_heads": shape.heads,
        "head_dim": shape.head_width,
        "hidden_activation": "gelu_pytorch_tanh",
        "rms_norm_eps": 1e-6,
        "rope_theta": shape.rope_theta,
    }


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
