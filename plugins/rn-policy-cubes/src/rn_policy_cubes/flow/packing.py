"""Packed weights of the flow policy: its tensors in half precision, and their description."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from pydantic import BaseModel, ConfigDict
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from rn_policy_cubes.curve import CURVE_FILE, newest_figures
from rn_policy_cubes.flow.network import CubesFlowNetwork
from rn_policy_cubes.flow.recipe import FlowRecipe
from rn_policy_cubes.flow.training import FlowTraining
from rn_policy_cubes.learner import STATE_FILE
from roboneuron import ConfigurationError

_CARD = "flow_card"


class FlowCard(BaseModel):
    """Description of packed weights.

    Attributes:
        recipe: recipe of their training.
        vocabulary: rows of the token embedding.
        step: optimiser steps done; fewer than the recipe's if training was stopped early.
        cpu_s: CPU time of these steps.
        figures: metrics on held-out views, by name.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    recipe: FlowRecipe
    vocabulary: int
    step: int
    cpu_s: float
    figures: dict[str, float] = {}


@dataclass(frozen=True, slots=True)
class FlowPacked:
    """The content of a packed file.

    Attributes:
        card: its description.
        tensors: float16, by parameter name of the trainable network.
    """

    card: FlowCard
    tensors: Mapping[str, Tensor]

    @classmethod
    def of(cls, network: CubesFlowNetwork, card: FlowCard) -> FlowPacked:
        """Pack a network; its weights are rounded to half precision."""
        state = network.state_dict()
        return cls(card, {n: value.detach().cpu().half() for n, value in state.items()})

    @classmethod
    def read(cls, path: Path) -> FlowPacked:
        """Read a file of `write`. Raises ConfigurationError if it holds another policy."""
        with safe_open(path, framework="pt") as file:
            card = (file.metadata() or {}).get(_CARD)
            if card is None:
                raise ConfigurationError(
                    f"{path} holds no packed flow policy.",
                    hint="Pack one: roboneuron policy cubes flow pack --to FILE",
                )
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        return cls(FlowCard.model_validate_json(card), tensors)

    def write(self, path: Path) -> None:
        """Write one safetensors file with the card in its header."""
        save_file(dict(self.tensors), path, metadata={_CARD: self.card.model_dump_json()})

    def network(self) -> CubesFlowNetwork:
        """The trainable network with these weights."""
        network = CubesFlowNetwork(self.card.recipe.shape, self.card.vocabulary)
        network.load_state_dict({name: value.float() for name, value in self.tensors.items()})
        return network


def pack_flow(directory: Path) -> FlowPacked:
    """The averaged weights of a training, with the newest metrics of its curve.

    Raises:
        ConfigurationError: there is no training in the folder.
    """
    path = directory / STATE_FILE
    if not path.exists():
        raise ConfigurationError(
            f"{directory} holds no training.", hint="Start one: roboneuron policy cubes flow train"
        )
    saved = torch.load(path, map_location="cpu", weights_only=True)
    recipe = FlowRecipe.model_validate(saved["recipe"])
    vocabulary = saved["vocabulary"]
    training = FlowTraining.read(path, recipe, vocabulary, torch.device("cpu"))
    card = FlowCard(
        recipe=recipe,
        vocabulary=vocabulary,
        step=training.step,
        cpu_s=training.cpu_s,
        figures=newest_figures(directory / CURVE_FILE),
    )
    return FlowPacked.of(training.average, card)
