"""Packed weights: the trained tensors, by name in the public layout; zero tensors are left out.

The public layout has a table of 32,064 embeddings, of which a few hundred were trained, an output
head that is never read, and the last block and the pooling head of the vision towers, which are
never run. The unused parts are left out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from pydantic import BaseModel, ConfigDict
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from rn_policy_cubes.network import CubesNetwork
from rn_policy_cubes.recipe import Recipe

EMBEDDING = "language_model.model.embed_tokens.weight"
HEAD, PROPRIO = "action_head.", "proprio_projector."
"""Name prefixes of tensors that have their own files."""
_IDS = "embed_ids"
_CARD = "card"
_TOWERS = ("featurizer", "fused_featurizer")


class Card(BaseModel):
    """Description of packed weights.

    Attributes:
        recipe: recipe of their training.
        step: optimiser steps done; fewer than the recipe's if training was stopped early.
        cpu_s: CPU time of these steps.
        figures: metrics on held-out views, by name.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    recipe: Recipe
    step: int
    cpu_s: float
    figures: dict[str, float] = {}


@dataclass(frozen=True, slots=True)
class Packed:
    """The content of a packed file.

    Attributes:
        card: its description.
        ids: int64 (n,), token ids that have an embedding.
        tensors: float32, by name in the public layout; `EMBEDDING` has only the n rows of `ids`.
    """

    card: Card
    ids: Tensor
    tensors: Mapping[str, Tensor]

    @classmethod
    def of(cls, network: CubesNetwork, card: Card) -> Packed:
        """Pack a network."""
        return cls(card, torch.tensor(network.ids), public_tensors(network))

    @classmethod
    def read(cls, path: Path) -> Packed:
        """Read a file written by `write`."""
        with safe_open(path, framework="pt") as file:
            card = Card.model_validate_json(file.metadata()[_CARD])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        return cls(card, tensors.pop(_IDS), tensors)

    def write(self, path: Path) -> None:
        """Write one safetensors file with the card in its header."""
        save_file(
            {_IDS: self.ids, **self.tensors}, path, metadata={_CARD: self.card.model_dump_json()}
        )


def public_tensors(network: CubesNetwork) -> dict[str, Tensor]:
    """Every trained tensor by its public name, in its public shape."""
    tensors: dict[str, Tensor] = {}
    for name, value in network.state_dict().items():
        for public, part in _public(name, value.detach().float().cpu()):
            tensors[public] = part.contiguous().clone()
    return tensors


def _public(name: str, value: Tensor) -> list[tuple[str, Tensor]]:
    if found := re.fullmatch(r"towers\.(\d)\.(.+)", name):
        return [
            (
                f"vision_backbone.{_TOWERS[int(found[1])]}.{_of_tower(found[2])}",
                _shaped(found[2], value),
            )
        ]
    if found := re.fullmatch(r"layers\.(\d+)\.(.+)", name):
        base = f"language_model.model.layers.{found[1]}."
        return [(base + public, part) for public, part in _of_layer(found[2], value)]
    if name == "embed":
        return [(EMBEDDING, value)]
    if name == "norm":
        return [("language_model.model.norm.weight", value)]
    if found := re.fullmatch(r"head\.blocks\.(\d)\.(.+)", name):
        return [(f"{HEAD}mlp_resnet_blocks.{found[1]}.ffn.{found[2]}", value)]
    return [(name.replace("head.", HEAD, 1) if name.startswith("head.") else name, value)]


def _of_tower(name: str) -> str:
    name = name.replace("patch.", "patch_embed.proj.")
    name = (
        re.sub(r"\.(qkv|proj)\.(weight|bias)$", r".attn.\1.\2", name)
        if name.startswith("blocks.")
        else name
    )
    name = re.sub(r"\.(fc[12])\.", r".mlp.\1.", name)
    return re.sub(r"\.(ls[12])$", r".\1.scale_factor", name)


def _shaped(name: str, value: Tensor) -> Tensor:
    return value.view(len(value), 3, 14, 14) if name == "patch.weight" else value


def _of_layer(name: str, value: Tensor) -> list[tuple[str, Tensor]]:
    if name == "qkv.weight":
        return [
            (f"self_attn.{n}_proj.weight", part)
            for n, part in zip("qkv", value.chunk(3), strict=True)
        ]
    if name == "gate_up.weight":
        return [
            (f"mlp.{n}_proj.weight", part)
            for n, part in zip(("gate", "up"), value.chunk(2), strict=True)
        ]
    public = {
        "out.weight": "self_attn.o_proj.weight",
        "down.weight": "mlp.down_proj.weight",
        "norm_in": "input_layernorm.weight",
        "norm_post": "post_attention_layernorm.weight",
    }
    return [(public[name], value)]


def network_of(packed: Packed) -> CubesNetwork:
    """The trainable network with these weights; the inverse of `Packed.of`."""
    network = CubesNetwork(packed.card.recipe.shape, packed.ids.tolist())
    state: dict[str, object] = {}
    for name, value in network.state_dict().items():
        parts = [
            packed.tensors[public].flatten(1)
            if "patch_embed.proj.weight" in public
            else packed.tensors[public]
            for public, _ in _public(name, value)
        ]
        state[name] = torch.cat(parts)
    network.load_state_dict(state)
    return network
