"""Reach a random point; seeds ending in 7 crash, those ending in 3 are unreachable."""

from __future__ import annotations

import os
import time

import numpy as np
from pydantic import BaseModel, ConfigDict

from rn_eval.suite import Episode, Judgement
from roboneuron import ActionChunk, Frame, Observation, Pose, UngroundedError

DOWN = np.array([1.0, 0.0, 0.0, 0.0])


class ToyOptions(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    crashes: bool = False
    slow_s: float = 0.0
    deadly: int = -1


class Toy:
    def __init__(self, config):
        self.options = config or ToyOptions()

    def episodes(self, count, first_seed):
        return [
            Episode(task=f"reach-{seed % 2}", seed=seed, instruction="reach", time_limit_s=3.0)
            for seed in range(first_seed, first_seed + count)
        ]

    def open(self, episode, setup):
        if self.options.crashes and episode.seed % 10 == 7:
            raise RuntimeError("the simulator crashed")
        if episode.seed == self.options.deadly:
            os._exit(1)
        time.sleep(self.options.slow_s)
        return ToyScene(episode)

    def close(self):
        pass


class ToyScene:
    tick_s, camera_ticks, judge_ticks = 0.01, 5, 10

    def __init__(self, episode):
        random = np.random.default_rng(episode.seed)
        self.goal = random.uniform(-0.3, 0.3, 3) + (9.0 if episode.seed % 10 == 3 else 0.0)
        self.here, self.speed, self.opened = np.zeros(3), np.zeros(3), episode

    def observe(self, stamp_ns):
        image = np.zeros((32, 32, 3), np.uint8)
        image[:, :, 0] = int(np.clip(120 + 300 * self.here[0], 0, 255))
        frame = Frame(camera="front", image=image, stamp_ns=stamp_ns, frame_id="front")
        pose = Pose(position_m=self.goal - self.here, quaternion_xyzw=DOWN, stamp_ns=stamp_ns)
        return Observation(
            frames={"primary": frame},
            instruction="reach",
            ee_pose=pose,
            gripper_open=1.0,
            stamp_ns=stamp_ns,
        )

    def act(self, vector, now_s):
        self.speed = vector[:3] / 0.1
        return ""

    def watch(self, now_s):
        pass

    def advance(self, ticks):
        self.here = self.here + self.speed * self.tick_s * ticks

    def judge(self):
        distance = float(np.linalg.norm(self.goal - self.here))
        facts = {"distance_m": round(distance, 4), "right_object": 1.0}
        return Judgement(
            success=distance < 0.03,
            is_over=distance < 0.03,
            reason="It was not reached.",
            facts=facts,
        )

    def state(self):
        return self.here.tobytes()

    def close(self):
        pass


class Steer:
    def __init__(self, config, runtime=None, acceleration=None):
        self.random = np.random.default_rng(0)

    def load(self):
        pass

    def reset(self):
        self.random = np.random.default_rng(0)

    def close(self):
        pass

    def predict(self, observation: Observation) -> ActionChunk:
        return self.answer(observation, 0.002 * self.random.standard_normal(3))

    def answer(self, observation, noise):
        away = observation.ee_pose.position_m
        if np.linalg.norm(away) > 20.0:
            raise UngroundedError("Too far.")
        step = away / max(1.0, np.linalg.norm(away) / 0.2) / 8 + noise
        rows = np.concatenate([np.tile(step, (8, 1)), np.zeros((8, 3)), np.ones((8, 1))], axis=1)
        return ActionChunk(actions=rows, step_s=0.1, metrics={"tokens_kept": 64.0}, note="steer")


class SteerBatch(Steer):
    """Stateless, so it can predict in batches."""

    def predict(self, observation):
        return self.answer(observation, np.zeros(3))

    def predict_batch(self, observations):
        return [self.answer(observation, np.zeros(3)) for observation in observations]
