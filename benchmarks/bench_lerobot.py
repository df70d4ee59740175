"""Overhead of the boundary between the robot and a LeRobot policy, compared with calling the policy
directly.

    .venv-lerobot-policies/bin/python benchmarks/bench_lerobot.py [--rounds 200]

The policy computes nothing, so the differences are those of the boundary: LeRobot's own calls in
this process, the backend `lerobot` in this process (as an inference module has it), and the backend
in the model server of rn-backend-openpi. Calls are interleaved, with one thread of PyTorch; numbers
are medians of the differences within a round.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rn_backend_lerobot.backend import LeRobotBackend
from rn_backend_lerobot.options import LeRobotOptions
from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.options import PolicyOptions
from roboneuron import Frame, JointSample, Observation, Pose

JOINTS = tuple(f"fr3_joint{i}" for i in range(1, 8))
NAMES = (*JOINTS, "gripper_open")
CAMERAS = (("primary", "front"), ("wrist", "wrist"))
LIMITS_MS = {"224x224": 1.0, "640x480 x 2": 3.0}
CONFIGURATION = """
from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig


@PreTrainedConfig.register_subclass("null")
@dataclass
class NullConfig(PreTrainedConfig):
    chunk_size: int = 16
    n_action_steps: int = 16
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.MEAN_STD,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )

    observation_delta_indices = None
    action_delta_indices = None
    reward_delta_indices = None

    def get_optimizer_preset(self):
        raise NotImplementedError

    def get_scheduler_preset(self):
        return None

    def validate_features(self):
        pass
"""
MODEL = """
import torch
from lerobot.policies.pretrained import PreTrainedPolicy

from lerobot_policy_null.configuration_null import NullConfig


class NullPolicy(PreTrainedPolicy):
    config_class = NullConfig
    name = "null"

    def __init__(self, config, **options):
        super().__init__(config)
        self.offset = torch.nn.Parameter(torch.zeros(1))

    def get_optim_params(self):
        return self.parameters()

    def reset(self):
        pass

    def forward(self, batch):
        raise NotImplementedError

    def predict_action_chunk(self, batch, **options):
        state = batch["observation.state"]
        return self.offset + state[:, None].expand(-1, self.config.chunk_size, -1)

    def select_action(self, batch, **options):
        return self.predict_action_chunk(batch)[:, 0]
"""


def install(site: Path) -> None:
    """Install a third party's policy, which LeRobot finds by the name of its package."""
    package, info = site / "lerobot_policy_null", site / "lerobot_policy_null-1.0.dist-info"
    package.mkdir(parents=True)
    info.mkdir()
    (package / "__init__.py").write_text("from lerobot_policy_null import configuration_null\n")
    (package / "configuration_null.py").write_text(CONFIGURATION)
    (package / "modeling_null.py").write_text(MODEL)
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: lerobot_policy_null\nVersion: 1.0\n"
    )


def make_checkpoint(directory: Path, cameras: tuple[str, ...], width: int, height: int) -> None:
    """Create a policy that answers its normalised state."""
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.processor.factory import make_default_pre_post_processors

    # created by `install` just before
    configuration = importlib.import_module("lerobot_policy_null.configuration_null")
    modeling = importlib.import_module("lerobot_policy_null.modeling_null")
    keys = [f"observation.images.{camera}" for camera in cameras]
    image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, height, width))
    vector = (len(NAMES),)
    config = configuration.NullConfig(
        device="cpu",
        input_features={
            **dict.fromkeys(keys, image),
            "observation.state": PolicyFeature(type=FeatureType.STATE, shape=vector),
        },
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=vector)},
    )
    numbers = {"mean": torch.zeros(vector), "std": torch.ones(vector)}
    pixels = {"mean": torch.full((3, 1, 1), 0.5), "std": torch.full((3, 1, 1), 0.2)}
    statistics_of = {**dict.fromkeys(keys, pixels), "observation.state": numbers, "action": numbers}
    before, after = make_default_pre_post_processors(config, statistics_of)
    for part in (modeling.NullPolicy(config), before, after):
        part.save_pretrained(directory)


def observe(cameras: tuple[str, ...], width: int, height: int, random: Any) -> Observation:
    """An observation of noise and joints."""
    frames = {
        role: Frame(
            camera=camera,
            image=random.integers(0, 256, (height, width, 3), dtype=np.uint8),
            stamp_ns=1,
            frame_id="optical",
        )
        for role, camera in CAMERAS
        if camera in cameras
    }
    pose = Pose(position_m=np.zeros(3), quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]))
    joints = JointSample(names=JOINTS, position=random.normal(size=7))
    return Observation(
        frames=frames, instruction="go", joints=joints, ee_pose=pose, gripper_open=0.5, stamp_ns=1
    )


def lerobots_own(directory: Path) -> Callable[[Observation], Any]:
    """LeRobot's calls, as in its own loop, on the data of its robots."""
    import torch
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from lerobot.policies.utils import prepare_observation_for_inference

    torch.set_num_threads(1)
    config = PreTrainedConfig.from_pretrained(directory)
    policy = get_policy_class(config.type).from_pretrained(directory, config=config)
    before, after = make_pre_post_processors(config, str(directory))

    def ask(observation: Observation) -> Any:
        joints = observation.joints
        assert joints is not None
        state = np.array([*joints.position, observation.gripper_open], dtype=np.float32)
        seen = {f"observation.images.{f.camera}": f.image for f in observation.frames.values()}
        with torch.inference_mode():
            prepared = prepare_observation_for_inference(
                {**seen, "observation.state": state}, torch.device("cpu"), "go", ""
            )
            return after(policy.predict_action_chunk(before(prepared))).numpy()

    return ask


def measure(folder: Path, site: Path, name: str, rounds: int) -> dict[str, float]:
    """Times of the three in milliseconds, and the overhead of the two boundaries."""
    size, _, two = name.partition(" x ")
    width, height = (int(part) for part in size.split("x"))
    cameras = ("front", "wrist") if two else ("front",)
    directory = folder / name.replace(" ", "")
    make_checkpoint(directory, cameras, width, height)
    options = {
        "rate_hz": 30.0,
        "joints": NAMES,
        "joint_unit": "radians",
        "gripper_unit": "open_fraction",
        "device": "cpu",
        "threads": 1,
    }
    own = lerobots_own(directory)
    backend = LeRobotBackend(LeRobotOptions.model_validate({**options, "checkpoint": directory}))
    backend.load()
    run = folder / "run"
    run.mkdir(mode=0o700, exist_ok=True)
    shared = PolicyBackend(
        PolicyOptions.model_validate(
            {
                "backend": "lerobot",
                "checkpoint": str(directory),
                "options": options,
                "directory": str(run),
                "environment": {"PYTHONPATH": str(site)},
                "idle_s": 1.0,
                "linger_s": 0.0,
                "timeout_s": 30.0,
            }
        )
    )
    shared.load()
    random = np.random.default_rng(0)
    asked: dict[str, Callable[[Observation], Any]] = {
        "lerobot": own,
        "module": backend.predict,
        "server": shared.predict,
    }
    took_ms: dict[str, list[float]] = {which: [] for which in asked}
    for number in range(rounds + 10):
        seen = observe(cameras, width, height, random)
        for which, ask in asked.items():
            begin_s = time.perf_counter()
            ask(seen)
            if number >= 10:
                took_ms[which].append((time.perf_counter() - begin_s) * 1e3)
    shared.close()
    backend.close()
    base = took_ms["lerobot"]
    found = {which: statistics.median(values) for which, values in took_ms.items()}
    for which in ("module", "server"):
        more = [value - b for value, b in zip(took_ms[which], base, strict=True)]
        found[f"{which}_adds"] = statistics.median(more)
    return found


def main() -> int:
    """Print a table; 1 if a boundary exceeds its limit."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--json", type=Path, help="write the numbers there too")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        site = folder / "site"
        install(site)
        sys.path.insert(0, str(site))
        os.environ["PYTHONPATH"] = str(site)
        results = {size: measure(folder, site, size, given.rounds) for size in LIMITS_MS}
    columns = ("images", "LeRobot [ms]", "backend [ms]", "server [ms]", "backend adds")
    print(f"| {' | '.join((*columns, 'server adds', 'at most'))} |")
    print("|---|---|---|---|---|---|---|")
    for size, row in results.items():
        numbers = [
            row[key] for key in ("lerobot", "module", "server", "module_adds", "server_adds")
        ]
        shown = " | ".join(f"{number:.2f}" for number in numbers)
        print(f"| {size} | {shown} | {LIMITS_MS[size]:g} |")
    if given.json is not None:
        given.json.write_text(json.dumps(results, indent=1))
    over = [
        size
        for size, row in results.items()
        if max(row["module_adds"], row["server_adds"]) > LIMITS_MS[size]
    ]
    if over:
        print(f"More than allowed: {', '.join(over)}")
    return 1 if over else 0


if __name__ == "__main__":
    sys.exit(main())
