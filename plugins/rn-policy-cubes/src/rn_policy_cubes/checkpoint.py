"""Conversion of packed weights to a folder in the public OpenVLA-OFT layout, which rn-backend-oft
loads like any other.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from rn_policy_cubes.network import PIXELS
from rn_policy_cubes.packing import EMBEDDING, HEAD, PROPRIO, Packed
from rn_policy_cubes.recipe import (
    ACTION_SCALE,
    GRID,
    PADDING,
    PATCH_PX,
    STATE_HIGH,
    STATE_LOW,
    VOCABULARY,
    NetworkShape,
)
from rn_policy_cubes.teacher import STEP_S
from rn_policy_cubes.weights import shipped_weights
from rn_policy_cubes.words import write_tokenizer
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from roboneuron import ConfigurationError
from roboneuron.feature import reading

DATA_SET = "cubes"
"""Key of the statistics."""
BACKEND = "oft-primary"
OPTIONS: Mapping[str, object] = {
    "profile": "own",
    "own_profile": {
        "metres_per_unit": 1.0,
        "radians_per_unit": 1.0,
        "rotation": "rotvec",
        "gripper": "open_fraction",
        "step_s": STEP_S,
    },
    "constants": "bridge",
    "proprio": True,
}
"""Options of the backend for which the weights were trained, without `checkpoint`."""
CONFIGURATION_FILE = "roboneuron.toml"
SERVED_FILE = "policies.toml"


def unpack(packed: Packed, directory: Path, becomes: Path | None = None) -> None:
    """Write config.json, weights, processor, tokenizer, statistics, head and projector into a new
    or empty folder.

    Also writes a roboneuron.toml that runs this checkpoint on the simulated robot, and a
    policies.toml that serves it to robots on other machines; both contain the folder `becomes`, if
    it will be renamed.

    Raises:
        ConfigurationError: the folder is not empty.
    """
    named = becomes or directory
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise ConfigurationError(
            f"{directory} exists and is not an empty directory.", hint="Name a new directory."
        )
    directory.mkdir(parents=True, exist_ok=True)
    statistics = {DATA_SET: _statistics()}
    _write_json(directory / "config.json", _config(packed.card.recipe.shape, statistics))
    _write_json(directory / "preprocessor_config.json", _processor())
    _write_json(directory / "dataset_statistics.json", statistics)
    write_tokenizer(directory / "tokenizer.json")
    _write_model(packed, directory)
    step = packed.card.step
    for prefix, file, inner in (
        (HEAD, f"action_head--{step}_checkpoint.pt", "module.model."),
        (PROPRIO, f"proprio_projector--{step}_checkpoint.pt", "module."),
    ):
        tensors = {
            inner + n.removeprefix(prefix): t
            for n, t in packed.tensors.items()
            if n.startswith(prefix)
        }
        torch.save(tensors, directory / file)
    (directory / CONFIGURATION_FILE).write_text(configuration(named), encoding="utf-8")
    (directory / SERVED_FILE).write_text(served(named), encoding="utf-8")


def shipped_configuration(output: Path) -> Path:
    """Unpack the shipped weights into a folder of `output`; returns the configuration that runs
    them on the simulated robot.

    Raises:
        ConfigurationError: this build has no weights.
    """
    packed = Packed.read(shipped_weights())
    directory = output / "learned-policy"
    shutil.rmtree(directory, ignore_errors=True)
    unpack(packed, directory)
    return directory / CONFIGURATION_FILE


def configuration(directory: Path) -> str:
    """The embedded default configuration with this checkpoint as the policy, as TOML."""
    text = reading.default_text().replace('backend = "servo"', f"backend = {json.dumps(BACKEND)}")
    at = {"checkpoint": str(directory.resolve())}
    return text + "\n" + "\n".join(_tables(f"plugins.{BACKEND}", at)) + "\n"


def served(directory: Path) -> str:
    """The file of `roboneuron policy serve` with this checkpoint as its only model, as TOML."""
    lines = [
        "# Read by `roboneuron policy serve`.",
        "",
        f"[models.{DATA_SET}]",
        *toml_lines({"backend": BACKEND, "checkpoint": str(directory.resolve())}),
        "",
        *_tables(f"models.{DATA_SET}.options", {}),
    ]
    return "\n".join(lines) + "\n"


def _tables(name: str, first: Mapping[str, object]) -> list[str]:
    """TOML of the table `name`, with `first` and the options of the backend."""
    options = {**first, **OPTIONS}
    own = options.pop("own_profile")
    assert isinstance(own, Mapping)
    return [f"[{name}]", *toml_lines(options), "", f"[{name}.own_profile]", *toml_lines(own)]


def toml_lines(values: Mapping[str, object]) -> list[str]:
    """Keys and values of a table as TOML."""
    return [f"{name} = {json.dumps(value)}" for name, value in values.items()]


def _write_model(packed: Packed, directory: Path) -> None:
    """Write the base model; tensors missing in the packed file are zero."""
    tensors: dict[str, Tensor] = {}
    for name, weight in OpenvlaCheckpoint.read(directory).shards[0].weights.items():
        if name == EMBEDDING:
            value = torch.zeros(weight.shape)
            value[packed.ids] = packed.tensors[EMBEDDING]
        elif name in packed.tensors:
            value = packed.tensors[name]
        else:
            value = torch.zeros(weight.shape, dtype=torch.bfloat16)
        if tuple(value.shape) != tuple(weight.shape):
            raise ConfigurationError(
                f"{name} has shape {tuple(value.shape)}, the layout has {tuple(weight.shape)}."
            )
        tensors[name] = value.contiguous()
    save_file(tensors, directory / "model.safetensors", metadata={"format": "pt"})


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _config(shape: NetworkShape, statistics: Mapping[str, object]) -> Mapping[str, object]:
    return {
        "architectures": ["OpenVLAForActionPrediction"],
        "model_type": "openvla",
        "vision_backbone_id": "dinosiglip-vit-so-224px",
        "llm_backbone_id": "llama2-7b-pure",
        "image_resize_strategy": "resize-naive",
        "pad_token_id": VOCABULARY - PADDING,
        "pad_to_multiple_of": PADDING,
        "n_action_bins": 256,
        "torch_dtype": "float32",
        "text_config": {
            "model_type": "llama",
            "hidden_size": shape.hidden,
            "intermediate_size": shape.intermediate,
            "num_hidden_layers": shape.layers,
            "num_attention_heads": shape.heads,
            "vocab_size": VOCABULARY,
            "rope_theta": shape.rope_theta,
            "rms_norm_eps": 1e-6,
        },
        "norm_stats": statistics,
        "tiny_vision_overrides": {
            "embed_dim": shape.vision_width,
            "depth": shape.vision_depth,
            "num_heads": shape.vision_heads,
        },
    }


def _statistics() -> Mapping[str, object]:
    low, high = [-scale for scale in ACTION_SCALE] + [0.0], [*ACTION_SCALE, 1.0]
    return {
        "action": _range(low, high, [True] * 6 + [False]),
        "proprio": _range(list(STATE_LOW), list(STATE_HIGH), [True] * len(STATE_LOW)),
        "num_transitions": 1,
        "num_trajectories": 1,
    }


def _range(low: list[float], high: list[float], mask: list[bool]) -> Mapping[str, object]:
    still, unit = [0.0] * len(low), [1.0] * len(low)
    return {
        "min": low,
        "max": high,
        "q01": low,
        "q99": high,
        "mean": still,
        "std": unit,
        "mask": mask,
    }


def _processor() -> Mapping[str, object]:
    return {
        "image_processor_type": "PrismaticImageProcessor",
        "image_resize_strategy": "resize-naive",
        "input_sizes": [[3, GRID * PATCH_PX, GRID * PATCH_PX]] * 2,
        "tvf_do_letterbox": False,
        "tvf_normalize_params": [{"mean": list(mean), "std": list(std)} for mean, std in PIXELS],
    }
