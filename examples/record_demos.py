"""Record demonstrations of the classical policy in simulation as a LeRobotDataset: `make
record-demos`.

rn-eval runs the episodes on the simulation's clock, so 50 take minutes. Each becomes a separate
run: images, joint states, TCP poses, predictions and actions on the topics of a real robot, stamped
with simulated time.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_eval.plan import EvalPlan
from rn_eval.policy import EpisodePolicy, load_backend
from rn_eval.runner import Runner
from rn_eval.suite import Episode, Scene, Setup, Suite
from rn_recorder.feature import CONTRACT
from rn_recorder_runs.files import Record, RunFile, write_json
from rn_recorder_runs.images import to_string
from rn_recorder_runs.lerobot import export
from rn_recorder_runs.predictions import prediction_record
from rn_recorder_runs.store import RUN_FILE, RunStore
from roboneuron import ActionChunk, Observation, __version__
from roboneuron.config import load_config
from roboneuron.plugins.discovery import discover
from roboneuron.ros.environment import prepare_environment

START_NS = 1_000_000_000
"""Start of simulated time, as in rn-eval."""
NAMESPACE = "/fr3"


class Tape:
    """The run being written: one file of messages as on ROS."""

    def __init__(self, store: RunStore, about: dict[str, str]) -> None:
        self._store, self._about = store, about
        self._file: RunFile | None = None
        self._sequences: dict[str, int] = {}
        self._now_ns = START_NS

    def begin(self, episode: Episode) -> None:
        """Start a new run."""
        self.run = f"demo-{episode.seed:05d}"
        self._instruction = episode.instruction
        folder = self._store.recordings / self.run
        folder.mkdir(parents=True, exist_ok=True)
        self._sequences = {}
        self._file = RunFile(
            folder / "part-0001.mcap", {**self._about, "run": self.run, "name": episode.instruction}
        )

    def end(self, outcome: str, reason: str) -> None:
        """Finish the run."""
        assert self._file is not None
        end = {"what": "episode_end", "at_ns": self._now_ns, "outcome": outcome, "reason": reason}
        self._add(
            "/roboneuron/events", "std_msgs/msg/String", self._now_ns, to_string(json.dumps(end))
        )
        self._file.finish()
        facts = {
            "outcome": outcome,
            "note": self._instruction,
            "begun_ns": START_NS,
            "state": "finished",
        }
        write_json(self._store.recordings / self.run / RUN_FILE, facts)
        self._file = None

    def observed(self, observation: Observation) -> None:
        """Record images and state."""
        from roboneuron.ros.messages import to_image, to_joint_state, to_pose_stamped

        for frame in observation.frames.values():
            self._message(
                f"{NAMESPACE}/camera/{frame.camera}/image", to_image(frame), frame.stamp_ns
            )
        assert observation.joints is not None
        assert observation.ee_pose is not None
        self._message(
            f"{NAMESPACE}/joint_states", to_joint_state(observation.joints), observation.stamp_ns
        )
        pose = replace(observation.ee_pose, stamp_ns=observation.stamp_ns)
        self._message(f"{NAMESPACE}/ee_pose", to_pose_stamped(pose, "base"), observation.stamp_ns)

    def predicted(
        self, observation: Observation, resets: bool, answer: ActionChunk | Exception
    ) -> None:
        """Record a prediction: the policy's input and answer."""
        text = prediction_record(observation, "sequential", resets, answer)
        self._add(
            f"{NAMESPACE}/predictions", "std_msgs/msg/String", observation.stamp_ns, to_string(text)
        )

    def acted(self, vector: NDArray[np.float64], now_s: float) -> None:
        """Record a sent action."""
        from roboneuron.ros.messages import to_action_message

        self._message(
            f"{NAMESPACE}/action", to_action_message(vector), START_NS + round(now_s * 1e9)
        )

    def _message(self, topic: str, message: object, at_ns: int) -> None:
        from rclpy.serialization import serialize_message

        package, kind = type(message).__module__.split(".")[:2]
        self._add(
            topic,
            f"{package}/{kind}/{type(message).__name__}",
            at_ns,
            bytes(serialize_message(message)),
        )

    def _add(self, topic: str, type_name: str, at_ns: int, data: bytes) -> None:
        assert self._file is not None
        self._now_ns = at_ns
        self._sequences[topic] = self._sequences.get(topic, 0) + 1
        self._file.write(Record(topic, type_name, at_ns, at_ns, self._sequences[topic], data))


class TapedScene:
    """A scene that records its observations and actions."""

    def __init__(self, scene: Scene, tape: Tape) -> None:
        self._scene, self._tape = scene, tape
        self.tick_s, self.camera_ticks, self.judge_ticks = (
            scene.tick_s,
            scene.camera_ticks,
            scene.judge_ticks,
        )
        self.advance, self.judge, self.state, self.watch = (
            scene.advance,
            scene.judge,
            scene.state,
            scene.watch,
        )
        self.close = scene.close

    def observe(self, stamp_ns: int) -> Observation:
        """See Scene."""
        observation = self._scene.observe(stamp_ns)
        self._tape.observed(observation)
        return observation

    def act(self, vector: NDArray[np.float64], now_s: float) -> str:
        """See Scene."""
        self._tape.acted(vector, now_s)
        return self._scene.act(vector, now_s)


class TapedSuite:
    """A suite that records its scenes, including the state for a policy that reads none."""

    def __init__(self, suite: Suite, tape: Tape) -> None:
        self._suite, self._tape = suite, tape
        self.close = suite.close

    def episodes(self, count: int, first_seed: int) -> Sequence[Episode]:
        """See Suite."""
        return self._suite.episodes(count, first_seed)

    def open(self, episode: Episode, setup: Setup) -> Scene:
        """See Suite."""
        return TapedScene(self._suite.open(episode, replace(setup, needs_state=True)), self._tape)


class TapedPolicy:
    """A policy that records its answers."""

    def __init__(self, policy: EpisodePolicy, tape: Tape) -> None:
        self._policy, self._tape = policy, tape
        self._resets = True
        self.close = policy.close

    def predict(self, observation: Observation) -> ActionChunk:
        """See Policy."""
        resets, self._resets = self._resets, False
        try:
            chunk = self._policy.predict(observation)
        except Exception as error:
            self._tape.predicted(observation, resets, error)
            raise
        self._tape.predicted(observation, resets, chunk)
        return chunk

    def reset(self) -> None:
        """See Policy."""
        self._resets = True
        self._policy.reset()


class TapedRunner(Runner):
    """Runs episodes with a recording."""

    def __init__(self, plan: EvalPlan, tape: Tape) -> None:
        super().__init__(
            plan, lambda preset: TapedPolicy(load_backend(plan, discover(), preset), tape)
        )
        self._suite = TapedSuite(self._suite, tape)


def main() -> int:
    """Record and export; status 1 if fewer episodes than requested succeeded."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=50, help="episodes (default: 50)")
    parser.add_argument("--seed", type=int, default=0, help="of the first (default: 0)")
    parser.add_argument(
        "--image-px", type=int, default=224, help="width and height of the images (default: 224)"
    )
    parser.add_argument("--codec", choices=("av1", "h264"), default="av1")
    parser.add_argument(
        "--out", type=Path, default=Path("out/demos"), help="folder (default: out/demos)"
    )
    arguments = parser.parse_args()
    prepare_environment(arguments.out / "log")
    config = load_config()
    plan = EvalPlan(
        suite="cubes",
        suite_options={"image_px": arguments.image_px},
        backend="servo",
        config=config.model_dump(mode="json"),
        episodes=arguments.n,
        first_seed=arguments.seed,
        strips="none",
    )
    store = RunStore(arguments.out / "runs")
    store.make()
    sections = {
        k: v for k, v in plan.config.items() if k in ("robot", "inference", "control", "limits")
    }
    about = {
        "robot": "fr3",
        "driver": "simulated",
        "namespace": "fr3",
        "images": "lossless",
        "roboneuron": __version__,
    }
    about |= {"contract": json.dumps(CONTRACT), "config": json.dumps(sections)}
    tape = Tape(store, about)
    runner = TapedRunner(plan, tape)
    runs, good = [], 0
    for job in plan.jobs(plan.build_suite(discover()).episodes(plan.episodes, plan.first_seed)):
        tape.begin(job.episode)
        record, _ = runner.run(job)
        tape.end(record.outcome.status, record.outcome.reason)
        runs.append(store.get(tape.run))
        good += record.outcome.status == "success"
        print(
            f"{tape.run}: {record.outcome.status}, {record.outcome.rows} actions, "
            f"{record.instruction}",
            flush=True,
        )
    runner.close()
    written = export(
        runs, arguments.out / "lerobot", outcome="success", fps=None, codec=arguments.codec
    )
    print(
        f"{arguments.out / 'lerobot'}: {written.episodes} episodes, {written.frames} frames at "
        f"{written.fps} Hz"
    )
    for left in written.skipped:
        print(f"Left out: {left}.")
    return 0 if good == arguments.n else 1


if __name__ == "__main__":
    sys.exit(main())
