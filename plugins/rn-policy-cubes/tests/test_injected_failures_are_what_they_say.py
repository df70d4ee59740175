"""Recorded episodes with injected failures: the simulator's truth fits their kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rn_policy_cubes.monitor.assessment import judge_files, observations
from rn_policy_cubes.monitor.command import EPISODES
from rn_policy_cubes.monitor.episodes import (
    FAILURES,
    HELD_S,
    InjectedEpisode,
    path_of,
    read_episode,
    record_episode,
    seed_of,
    write_episode,
)
from rn_policy_cubes.monitor.samples import Samples
from rn_policy_cubes.monitor.weights import MonitorWeights, shipped_monitor

INDEX = 70_000


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One success and one wrong cube."""
    made = tmp_path_factory.mktemp("episodes")
    for kind in ("success", "wrong_cube"):
        assert write_episode(made, kind, INDEX)
    return made


def episode(directory: Path, kind: str) -> InjectedEpisode:
    return read_episode(path_of(directory, kind, INDEX))


@pytest.mark.exhaustive
def test_an_episode_depends_only_on_kind_and_seed(directory: Path) -> None:
    assert not write_episode(directory, "success", INDEX), "it is there already"
    known = episode(directory, "success")
    again = record_episode("success", seed_of("success", INDEX))
    assert again.target == known.target
    np.testing.assert_array_equal(again.views, known.views)
    np.testing.assert_array_equal(again.pictures, known.pictures)


def test_no_two_episodes_share_a_scene() -> None:
    seeds = [
        seed_of(kind, index)
        for split in EPISODES.values()
        for kind, (first, end) in split.items()
        for index in range(first, end)
    ]
    assert len(set(seeds)) == len(seeds)
    assert {kind for split in EPISODES.values() for kind in split} == {"success", *FAILURES}
    assert set(EPISODES["test"]) == {"success", *FAILURES}


def test_a_success_is_held_and_another_cube_is_none(directory: Path) -> None:
    held, wrong = episode(directory, "success"), episode(directory, "wrong_cube")
    assert held.succeeded_s is not None
    assert held.views["held_s"][-1, held.target] > HELD_S + 2.0
    assert wrong.succeeded_s is None
    other = int(wrong.views["held_s"][-1].argmax())
    assert other != wrong.target
    assert wrong.views["held_s"][-1, other] > HELD_S + 2.0
    samples = Samples.of(wrong)
    assert samples.labels[-1, 0].tolist() == [float(cube == other) for cube in range(4)]
    assert samples.labels[-1, 2, wrong.target] == 1.0, "the hand is up without the named cube"
    assert Samples.of(held).labels[-1, 1, held.target] == pytest.approx(1.0)


def test_observations_are_as_a_task_sees_them(directory: Path) -> None:
    made = episode(directory, "success")
    seen = list(observations(made))
    assert len(seen) == len(made.views)
    last = seen[-1]
    assert last.ee_pose is not None
    assert last.frames["primary"].calibration is not None
    assert last.frames["primary"].stamp_ns == last.ee_pose.stamp_ns
    np.testing.assert_array_equal(last.frames["primary"].image, made.pictures[-1])


@pytest.mark.slow
@pytest.mark.parametrize("kind", FAILURES)
def test_no_failing_episode_succeeds(kind: str) -> None:
    for index in range(INDEX, INDEX + 3):
        made = record_episode(kind, seed_of(kind, index))
        assert kind == "frozen" or made.succeeded_s is None
        assert made.failed_s <= made.views["time_s"][-1]
        if kind == "frozen":
            assert (made.pictures[-1] == made.pictures[-2]).all()
        if kind == "occluded":
            assert made.views["is_hidden"].any()


def test_the_shipped_weights_tell_them_apart(directory: Path) -> None:
    weights = MonitorWeights.read(shipped_monitor())
    paths = [path_of(directory, kind, INDEX) for kind in ("success", "wrong_cube")]
    held, wrong = judge_files(paths, weights)
    assert held.claimed_s is not None
    assert -0.05 <= held.claimed_s <= 1.0
    assert not held.is_false_claim
    assert not held.is_false_alarm
    assert not wrong.is_false_claim
    assert wrong.noticed_s is not None
    assert held.last_progress > 0.9 > held.first_progress
