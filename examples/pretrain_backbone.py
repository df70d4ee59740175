"""Pretrain the backbone of an ACT to locate a cube: part of `make train-act`.

ACT's ResNet usually starts with ImageNet's weights, with frozen batch normalisation. If those
weights cannot be downloaded, a random ResNet without normalisation learns slowly. So a ResNet-18 is
first trained on images of the simulated cell, labelled by the simulator, to locate the cube. Its
weights then replace the backbone's in a checkpoint of `lerobot-train`.

The arm poses are those of the demonstrations with random changes; the cube positions are new, and
no action is learnt.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torchvision.models import resnet18

from rn_robot_fr3.profile import profile
from rn_robot_fr3.scene import REGION_X_M, REGION_Y_M
from rn_robot_fr3.simulation import ArmSimulation
from roboneuron import quaternion_from_matrix

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

CAMERAS = ("front", "wrist")
SIDE_PX = 96
FIRST_SEED = 40_000
"""First seed of the scenes; those of the demonstrations and of the evaluation are below."""
PER_SCENE = 32
"""Number of images with one size of cube."""
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""ImageNet's normalisation, which lerobot applies to images."""
BACKBONE = "model.backbone."
"""Prefix of the backbone's weights in a checkpoint of ACT."""
LABELS = 8
TOLD_BY = {"front": range(3), "wrist": range(3, 8)}
"""Labels that a camera can predict: it is mounted in the cell, or on the hand."""
LEAST_PX = 3
"""Minimum number of red pixels of a visible cube."""
BATCH, LEARNING_RATE, HELD_OUT = 32, 1e-3, 512


def arm_poses(data: Path) -> F64:
    """States of a LeRobot data set, float64 (n, 8): seven joints [rad], opening 0 .. 1."""
    rows = pq.read_table(sorted(data.glob("data/*/*.parquet")), columns=["observation.state"])
    states = np.stack(rows["observation.state"].to_numpy()).astype(np.float64)
    states[:, :7] = np.radians(states[:, :7])
    states[:, 7] /= 100.0
    return states


def take_pictures(poses: F64, count: int, random: np.random.Generator) -> tuple[U8, F32]:
    """Render `count` scenes: images uint8 (count, cameras, 3, side, side), labels (count, 8)."""
    pictures = np.zeros((count, len(CAMERAS), 3, SIDE_PX, SIDE_PX), dtype=np.uint8)
    labels = np.zeros((count, LABELS), dtype=np.float32)
    for first in range(0, count, PER_SCENE):
        with ArmSimulation(FIRST_SEED + first, colours=["red"], engine="mujoco") as simulation:
            for index in range(first, min(first + PER_SCENE, count)):
                labels[index] = _arrange(simulation, poses, random)
                for camera, name in enumerate(CAMERAS):
                    image = simulation.render(name, SIDE_PX, SIDE_PX)
                    pictures[index, camera] = image.transpose(2, 0, 1)
        if first % 2048 == 0:
            print(f"{first} of {count} scenes drawn", flush=True)
    return pictures, labels


def _arrange(simulation: ArmSimulation, poses: F64, random: np.random.Generator) -> F32:
    """Set random poses of arm and cube.

    Returns:
        Position of the cube in the base frame and in the TCP frame [m], and cosine and sine of four
        times its rotation relative to the fingers, float32 (8,).
    """
    gripper = profile().gripper
    assert gripper is not None
    pose = poses[random.integers(len(poses))] + np.append(random.normal(0.0, 0.04, 7), 0.0)
    held = random.random() < 0.15
    opening = float(random.uniform(0.5, 0.6) if held else np.clip(pose[7], 0.0, 1.0))
    finger_m = gripper.to_position(opening)
    simulation.world.set_joints([*pose[:7].tolist(), finger_m, finger_m])
    T_base_tcp = simulation.world.T_base_tcp()
    edge_m = simulation.scene[0].edge_m
    yaw_rad = float(random.uniform(-math.pi / 4, math.pi / 4))
    low, high = np.array([REGION_X_M, REGION_Y_M]).T
    if held:
        place = T_base_tcp[:3, 3] + random.normal(0.0, 0.006, 3)
        yaw_rad = math.atan2(T_base_tcp[1, 0], T_base_tcp[0, 0]) + float(random.normal(0.0, 0.1))
    elif random.random() < 0.5:
        near = T_base_tcp[:2, 3] + random.normal(0.0, 0.05, 2)
        place = np.append(np.clip(near, low - 0.03, high + 0.03), edge_m / 2)
    else:
        place = np.append(random.uniform(low - 0.02, high + 0.02), edge_m / 2)
    turned = np.array(
        [
            [math.cos(yaw_rad), -math.sin(yaw_rad), 0.0],
            [math.sin(yaw_rad), math.cos(yaw_rad), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    quaternion = tuple(quaternion_from_matrix(turned).tolist())
    simulation.world.set_cubes({"red": (tuple(place.tolist()), quaternion)})
    in_tcp = T_base_tcp[:3, :3].T @ (place - T_base_tcp[:3, 3])
    turn = 4.0 * (yaw_rad - math.atan2(T_base_tcp[1, 0], T_base_tcp[0, 0]))
    return np.array([*place, *in_tcp, math.cos(turn), math.sin(turn)], dtype=np.float32)


def seen_labels(pictures: U8) -> F32:
    """1 for each label that an image can predict, else 0, float32 (n, cameras, 8)."""
    red, green, blue = np.moveaxis(pictures.astype(np.int16), 2, 0)
    cube = (red > 80) & (red > 2 * green) & (red > 2 * blue)
    is_seen = cube.sum(axis=(2, 3)) >= LEAST_PX
    weights = np.zeros((*is_seen.shape, LABELS), dtype=np.float32)
    for camera, name in enumerate(CAMERAS):
        weights[:, camera, TOLD_BY[name]] = is_seen[:, camera, None]
    return weights


class Sight(nn.Module):
    """One ResNet-18 for all cameras, with a head per camera that predicts the labels."""

    def __init__(self) -> None:
        super().__init__()
        whole = resnet18(weights=None)
        self.backbone = nn.Sequential()
        for name, layer in whole.named_children():
            if name not in ("avgpool", "fc"):
                self.backbone.add_module(name, layer)
        cells = 512 * math.ceil(SIDE_PX / 32) ** 2
        self.heads = nn.ModuleList(
            nn.Sequential(nn.Flatten(), nn.Linear(cells, 256), nn.ReLU(), nn.Linear(256, LABELS))
            for _ in CAMERAS
        )
        self._mean = torch.tensor(MEAN)[:, None, None]
        self._std = torch.tensor(STD)[:, None, None]

    def forward(self, pictures: Tensor) -> Tensor:
        """Predicted labels per camera, (n, cameras, 8), for images (n, cameras, 3, h, w)."""
        images = (pictures.float() / 255.0 - self._mean) / self._std
        # all cameras in one batch, because ACT freezes the batch statistics of all of them together
        together = images.flatten(0, 1).contiguous(memory_format=torch.channels_last)
        features = self.backbone(together).unflatten(0, (-1, len(CAMERAS)))
        told = [head(features[:, camera]) for camera, head in enumerate(self.heads)]
        return torch.stack(told, dim=1).float()


def learn(pictures: U8, labels: F32, epochs: int) -> Sight:
    """Train a `Sight` for `epochs` on the images; the last ones are held out."""
    counts = seen_labels(pictures)
    # scaled by the visible ones, because a cube that the hand does not see may be far away
    unseen = counts.sum(axis=1) == 0.0
    told_labels = np.ma.masked_array(labels, unseen)
    centre, spread = told_labels.mean(axis=0).filled(), told_labels.std(axis=0).filled()
    scaled = torch.from_numpy((labels - centre) / spread)
    seen, weights = torch.from_numpy(pictures), torch.from_numpy(counts)
    sight = Sight()
    count = len(seen) - HELD_OUT
    steps = epochs * (count // BATCH)
    optimizer = torch.optim.AdamW(sight.parameters(), lr=LEARNING_RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=steps)
    for epoch in range(epochs):
        sight.train()
        order = torch.randperm(count)
        for step in range(count // BATCH):
            chosen = order[step * BATCH : (step + 1) * BATCH]
            with torch.autocast("cpu", dtype=torch.bfloat16):
                told = sight(seen[chosen])
            target = scaled[chosen][:, None].expand_as(told)
            wrong = nn.functional.smooth_l1_loss(told, target, reduction="none")
            loss = (wrong * weights[chosen]).sum() / weights[chosen].sum()
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            schedule.step()
        with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
            sight.eval()
            told = torch.cat([sight(part) for part in torch.split(seen[count:], BATCH)])
        wrong_by = np.abs(told.numpy() * spread + centre - labels[count:, None])
        _report(wrong_by, counts[count:] > 0, f"epoch {epoch + 1}/{epochs}")
    return sight


def _report(wrong: F32, counts: NDArray[np.bool_], when: str) -> None:
    """Print the median errors on held-out images; both arrays (n, cameras, 8)."""
    for camera, name in enumerate(CAMERAS):
        place = TOLD_BY[name][:3]
        off_m = np.linalg.norm(wrong[counts[:, camera, place[0]], camera][:, place], axis=1)
        print(f"{when}, {name}: cube within {1e3 * float(np.median(off_m)):.1f} mm", flush=True)


def put_into(checkpoint: Path, sight: Sight) -> None:
    """Replace the backbone in an ACT checkpoint.

    Raises:
        KeyError: the checkpoint has another backbone.
    """
    file = checkpoint / "model.safetensors"
    weights = load_file(file)
    # frozen batch normalisation has no counter of batches
    learnt = {
        f"{BACKBONE}{name}": value.contiguous()
        for name, value in sight.backbone.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }
    own = {name for name in weights if name.startswith(BACKBONE)}
    if own != learnt.keys():
        raise KeyError(f"{file} has no ResNet-18 as backbone: {sorted(own ^ learnt.keys())[:3]}")
    save_file({**weights, **learnt}, file, metadata={"format": "pt"})


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path, help="folder pretrained_model of an ACT")
    parser.add_argument("--data", type=Path, default=Path("out/lerobot/data"), help="data set")
    parser.add_argument("--scenes", type=int, default=12_000)
    parser.add_argument("--epochs", type=int, default=5)
    chosen = parser.parse_args()
    torch.manual_seed(0)
    pictures, labels = take_pictures(
        arm_poses(chosen.data), chosen.scenes, np.random.default_rng(0)
    )
    put_into(chosen.checkpoint, learn(pictures, labels, chosen.epochs))
    print(f"The backbone of {chosen.checkpoint} sees now.")


if __name__ == "__main__":
    main()
