"""Opens an imported data set with lerobot itself, compares its rows, and trains a small ACT on it.

Run by the interpreter of .venv-lerobot, which has lerobot 0.6.1 and neither ROS nor RoboNeuron:
    lerobot_act.py DATASET EXPECTED

EXPECTED is an .npz of all rows: `row_ns` (n,), `state` (n, j), `action` (n, k), and `front`
(n, H, W, 3) uint8.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from lerobot.configs.types import FeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.act.processor_act import make_act_pre_post_processors
from lerobot.utils.feature_utils import dataset_to_policy_features

MOST_ERROR = 6.0
"""Of a frame's mean difference, of 255: what JPEG and the codec may take."""
STEPS, CHUNK = 30, 4


def main(root: str, expected: str) -> None:
    """Compare and train; raises AssertionError."""
    with np.load(expected) as file:
        wanted = dict(file)
    dataset = LeRobotDataset("local/lab", root=root, video_backend="pyav")
    count = len(wanted["row_ns"])
    assert dataset.num_frames == count, (dataset.num_frames, count)
    for index in range(count):
        row = dataset[index]
        assert int(row["roboneuron.row_ns"]) == wanted["row_ns"][index], index
        for name, column in (("observation.state", "state"), ("action", "action")):
            assert np.array_equal(row[name].numpy(), np.float32(wanted[column][index])), index
        shown = row["observation.images.front"].numpy().transpose(1, 2, 0) * 255.0
        assert np.abs(shown - wanted["front"][index]).mean() < MOST_ERROR, index
    print(f"{count} frames equal")
    first, last = train(root, dataset)
    assert np.isfinite(last), last
    assert last < first / 2, (first, last)
    print(f"loss {first:.3f} -> {last:.3f}")


def train(root: str, dataset: LeRobotDataset) -> tuple[float, float]:
    """Loss of the first and of the last steps."""
    torch.manual_seed(0)
    features = dataset_to_policy_features(dataset.meta.features)
    outputs = {name: one for name, one in features.items() if one.type is FeatureType.ACTION}
    inputs = {name: one for name, one in features.items() if name.startswith("observation.")}
    config = ACTConfig(
        input_features=inputs,
        output_features=outputs,
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        dim_model=64,
        n_heads=4,
        dim_feedforward=128,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        pretrained_backbone_weights=None,
        device="cpu",
    )
    policy = ACTPolicy(config)
    policy.train()
    prepare, _ = make_act_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    times = {"action": [step / dataset.fps for step in range(CHUNK)]}
    chunks = LeRobotDataset("local/lab", root=root, video_backend="pyav", delta_timestamps=times)
    loader = torch.utils.data.DataLoader(chunks, batch_size=8, shuffle=True)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-3)
    losses: list[float] = []
    while len(losses) < STEPS:
        for batch in loader:
            loss, _ = policy.forward(prepare(batch))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
    return float(np.mean(losses[:3])), float(np.mean(losses[-3:]))


if __name__ == "__main__":
    main(*sys.argv[1:])
