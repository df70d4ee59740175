"""Files of a LeRobot checkpoint with random weights: features, statistics, processors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

HOME = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785, 0.5)
"""Mean of states and actions: seven joints [rad] of an arm, and a gripper [opening]."""
SPREAD = 0.05
"""Standard deviation of both; the actions of a random policy scatter by about this much."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TinyShape:
    """Inputs and outputs of a tiny policy.

    Attributes:
        cameras: short names of its image features.
        width, height: image size [px].
        means: mean of each value of state and action, in the units of the training data.
    """

    cameras: Sequence[str] = ("front", "wrist")
    width: int = 96
    height: int = 96
    means: Sequence[float] = HOME


class Saved(Protocol):
    def save_pretrained(self, directory: Path) -> None: ...


def _features(shape: TinyShape) -> tuple[dict[str, object], dict[str, object]]:
    """Inputs and outputs in the form of LeRobot's configurations."""
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
    """Statistics of a data set around `shape.means`; those of ImageNet for images."""
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


def write_policy(
    directory: Path,
    shape: TinyShape,
    configure: Callable[..., object],
    policy: Callable[[object], Saved],
    **settings: object,
) -> None:
    """Save a policy of random weights with its processors.

    Args:
        directory: destination.
        shape: its inputs and outputs.
        configure, policy: LeRobot's classes of the configuration and of the policy.
        settings: settings of this configuration, besides those common to all policies.
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
