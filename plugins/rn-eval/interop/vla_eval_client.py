"""vla-eval's own client and episode runner against RoboNeuron's model server; runs in vla-eval's
environment.

    .venv-vla-eval/bin/python plugins/rn-eval/interop/vla_eval_client.py ws://127.0.0.1:8000

The benchmark sends the same data as vla-eval's LIBERO adapter (names, sizes and conventions),
without a simulator. It fails if the declared conventions do not match, if an action violates them,
or if the runner reports an error.
"""

from __future__ import annotations

import sys
from typing import Any

import anyio
import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.connection import Connection
from vla_eval.runners.sync_runner import SyncEpisodeRunner
from vla_eval.specs import (
    GRIPPER_CLOSE_POS,
    IMAGE_RGB,
    LANGUAGE,
    POSITION_DELTA,
    ROTATION_AA,
    STATE_EEF_POS_AA_GRIP,
    DimSpec,
    check_specs,
)

STEPS = 20
ACTION = {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}


class LikeLibero(StepBenchmark):
    """Sends noise in LIBERO's form, and checks the answers."""

    def __init__(self, *, wrist: bool, state: bool) -> None:
        super().__init__()
        self.wrist, self.with_state = wrist, state
        self.actions: list[Any] = []
        self.random = np.random.default_rng(0)

    def get_tasks(self) -> list[dict[str, Any]]:
        return [{"name": "pick up the bowl", "suite": "libero_spatial", "task_id": 0}]

    def reset(self, task: dict[str, Any]) -> Any:
        return None

    def step(self, action: dict[str, Any]) -> StepResult:
        values = np.asarray(action["actions"])
        assert values.shape == (7,), values.shape
        for spec, part in zip(ACTION.values(), (values[:3], values[3:6], values[6:]), strict=True):
            assert not spec.validate(part), spec.validate(part)
        assert abs(values[6]) == 1.0, values[6]
        self.actions.append(values)
        return StepResult(obs=None, reward=0.0, done=len(self.actions) >= STEPS, info={})

    def make_obs(self, raw_obs: Any, task: dict[str, Any]) -> dict[str, Any]:
        images = {"agentview": self.random.integers(0, 255, (256, 256, 3), dtype=np.uint8)}
        if self.wrist:
            images["wrist"] = self.random.integers(0, 255, (256, 256, 3), dtype=np.uint8)
        observation: dict[str, Any] = {"images": images, "task_description": task["name"]}
        if self.with_state:
            observation["states"] = np.array([-0.2, 0.0, 1.17, 3.1, 0.0, -0.05, 0.0387, -0.0388])
        return observation

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        return {"success": step_result.done}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        spec = {"agentview": IMAGE_RGB, "language": LANGUAGE}
        if self.wrist:
            spec["wrist"] = IMAGE_RGB
        if self.with_state:
            spec["state"] = STATE_EEF_POS_AA_GRIP
        return spec


def specs_of(told: dict[str, dict[str, Any]]) -> dict[str, DimSpec]:
    """Parse the specifications declared in HELLO."""
    return {
        name: DimSpec(
            s["name"], s["dims"], s["format"], tuple(s["range"]) if "range" in s else None
        )
        for name, s in told.items()
    }


async def run(url: str) -> None:
    """Run one episode with vla-eval's runner."""
    async with Connection(url, timeout=120) as connection:
        info = connection.server_info
        wanted = info["observation_params"]
        benchmark = LikeLibero(wrist=wanted["send_wrist_image"], state=wanted["send_state"])
        mismatches = check_specs(
            specs_of(info["action_spec"]),
            ACTION,
            specs_of(info["observation_spec"]),
            benchmark.get_observation_spec(),
        )
        assert not mismatches, mismatches
        result = await SyncEpisodeRunner().run_episode(
            benchmark, benchmark.get_tasks()[0], connection, max_steps=STEPS + 5
        )
        assert result["metrics"]["success"], result
        refusal = ""
        try:
            await connection.act({"images": {}, "task_description": "x"})
        except RuntimeError as error:
            refusal = str(error)
        assert "expected" in refusal, "an observation without images was answered"
    print(f"served {len(benchmark.actions)} steps by {info['model_server']}")


if __name__ == "__main__":
    anyio.run(run, sys.argv[1])
