"""Replay: a deterministic backend repeats itself to the last bit, another one is told apart at its
first difference.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from recorder_demonstrations import CAMERAS, action, observation, picture, record_run, store_in

from rn_recorder_runs.comparison import AXES, compare, describe, write_report
from rn_recorder_runs.files import Record, RunFile, read_records
from rn_recorder_runs.images import IMAGE, to_string
from rn_recorder_runs.lerobot import export
from rn_recorder_runs.observations import Observations
from rn_recorder_runs.replay import EXACT, Compared, replay
from rn_recorder_runs.store import Run
from rn_testing.fakes import gantry_profile
from roboneuron import EE_DELTA, ActionChunk, InvalidInputError, Observation, UngroundedError
from roboneuron.modules.inference.agreement import SpaceAgreement

AGREEMENT = SpaceAgreement(declared=EE_DELTA, executed=EE_DELTA, columns=tuple(range(7)))
INSTRUCTIONS = [("pick up the cup", "success"), ("put it down", "failure")]


class Recomputing:
    """Answers as the run was recorded, as long as it sees exactly what was seen."""

    def __init__(self, wrong_from: int = 1000, refuses: int = -1) -> None:
        self.number = 0
        self.resets = 0
        self.wrong_from, self.refuses = wrong_from, refuses

    def load(self) -> None:
        """Nothing to load."""

    def predict(self, seen: Observation) -> ActionChunk:
        """Check the observation, and answer."""
        number = self.number
        self.number += 1
        if number == self.refuses:
            raise UngroundedError("There is no cup.")
        wanted = observation(number, seen.instruction, 1_700_000_000_000_000_000)
        assert {role: frame.camera for role, frame in seen.frames.items()} == CAMERAS
        for role, camera in CAMERAS.items():
            np.testing.assert_array_equal(seen.frames[role].image, picture(camera, number))
            assert seen.frames[role].stamp_ns == wanted.frames[role].stamp_ns
        assert seen.joints is not None
        assert wanted.joints is not None
        np.testing.assert_array_equal(seen.joints.position, wanted.joints.position)
        assert seen.ee_pose is not None
        assert seen.gripper_open == 0.5
        rows = action(number)[None, :].copy()
        if number >= self.wrong_from:
            rows[0, 2] += 0.004
        return ActionChunk(actions=rows, step_s=0.1)

    def reset(self) -> None:
        """Counted."""
        self.resets += 1

    def close(self) -> None:
        """Nothing to close."""


def replayed(run: Run, backend: Recomputing) -> list[Compared]:
    profile = gantry_profile()
    cameras = {
        role: camera
        for role, name in CAMERAS.items()
        if (camera := profile.camera(name)) is not None
    }
    return list(replay(Observations(run.files, cameras, frozenset(), profile), backend, AGREEMENT))


def test_a_deterministic_backend_repeats_itself(tmp_path: Path) -> None:
    backend = Recomputing()
    found = replayed(record_run(store_in(tmp_path), "demo", INSTRUCTIONS), backend)
    comparison = compare(found, EXACT)
    assert (comparison.predictions, comparison.diverging, comparison.first) == (16, 0, None)
    assert comparison.largest.max() == 0.0
    assert backend.resets == 3  # at the beginning, and with each instruction
    assert "All 16 predictions equal" in describe(comparison, found)


def cut_off(run: Run, images: int, path: Path) -> Run:
    """The run as recorded by somebody who came after so many images."""
    file = RunFile(path, {})
    left = images
    for record in read_records(run.files[0]):
        if left and record.type == IMAGE:
            left -= 1
        elif not left or not record.topic.endswith("/joint_states"):
            file.write(record)
    file.finish()
    return Run(id="late", kind="recording", files=(path,), facts={})


def test_predictions_from_images_before_the_run_are_left_out(tmp_path: Path) -> None:
    """A recording or an incident begins in the middle of what a policy does."""
    late = cut_off(record_run(store_in(tmp_path), "demo", INSTRUCTIONS), 3, tmp_path / "late.mcap")
    backend = Recomputing()
    backend.number = 2
    comparison = compare(replayed(late, backend), EXACT)
    assert (comparison.predictions, comparison.diverging) == (14, 0)
    assert export([late], tmp_path / "set", outcome=None, fps=None, codec="h264").frames >= 14


def test_a_camera_that_the_backend_did_without_is_left_out(tmp_path: Path) -> None:
    """Before the first image of an optional camera a policy acts without it."""
    profile, optional = gantry_profile(), frozenset({"wrist"})
    cameras = {
        role: camera
        for role, name in CAMERAS.items()
        if (camera := profile.camera(name)) is not None
    }
    run = record_run(store_in(tmp_path), "demo", INSTRUCTIONS)
    for roles in (optional, frozenset()):
        observations = Observations(run.files, cameras, roles, profile)
        del observations._streams.predictions[1].facts["frames"]["wrist"]
        seen = [set(observation.frames) for _, observation in observations]
        assert seen[0] == seen[2] == set(CAMERAS)
        assert seen[1] == set(CAMERAS) - roles  # a backend that needs it gets the one before


def without(
    run: Run, path: Path, *, predictions: tuple[int, ...] = (), images: tuple[int, ...] = ()
) -> Run:
    """The run as recorded where these were lost, by their numbers; images of the camera "front"."""
    file = RunFile(path, {})
    counts = {"predictions": 0, "front/image": 0}
    lost = {"predictions": predictions, "front/image": images}
    for record in read_records(run.files[0]):
        name = next((name for name in counts if record.topic.endswith(name)), None)
        if name is not None:
            counts[name] += 1
            if counts[name] - 1 in lost[name]:
                continue
        file.write(record)
    file.finish()
    return Run(id="gaps", kind="recording", files=(path,), facts={})


class Counting:
    """Answers by how often it was asked, whatever it sees, as a backend that remembers."""

    asked = 0

    def reset(self) -> None:
        """It remembers on."""

    def predict(self, seen: Observation) -> ActionChunk:
        """The action of that number."""
        self.asked += 1
        return ActionChunk(actions=action(self.asked - 1)[None, :], step_s=0.1)


def test_what_the_run_lacks_is_told(tmp_path: Path) -> None:
    """One lost image and one lost prediction: the others are compared, and the answer says what is
    missing.
    """
    run = record_run(store_in(tmp_path), "demo", INSTRUCTIONS)
    gappy = without(run, tmp_path / "gaps.mcap", predictions=(9,), images=(4,))
    profile = gantry_profile()
    cameras = {
        role: camera
        for role, name in CAMERAS.items()
        if (camera := profile.camera(name)) is not None
    }
    observations = Observations(gappy.files, cameras, frozenset(), profile)
    found = list(replay(observations, Counting(), AGREEMENT))  # type: ignore[arg-type]
    comparison = compare(found, EXACT, observations.gaps)
    assert (observations.gaps.predictions, observations.gaps.without_image) == (1, 1)
    assert comparison.predictions == 14
    assert (comparison.diverging, comparison.first) == (10, 4)
    text = describe(comparison, found)
    assert "The run lacks 1 predictions" in text
    assert (
        "and an image of 1 predictions (they were not compared), first 0.40 s after the beginning"
        in text
    )
    assert "What differs comes after that: a backend that remembers" in text
    assert (
        comparison.to_dict()["predictions_lost"]
        == comparison.to_dict()["predictions_without_image"]
        == 1
    )


def test_a_run_without_gaps_tells_of_none(tmp_path: Path) -> None:
    found = replayed(record_run(store_in(tmp_path), "demo", INSTRUCTIONS), Recomputing())
    assert "lacks" not in describe(compare(found, EXACT), found)


def test_a_run_without_its_images_is_refused(tmp_path: Path) -> None:
    run = without(
        record_run(store_in(tmp_path), "demo", INSTRUCTIONS),
        tmp_path / "a.mcap",
        images=tuple(range(1, 99)),
    )
    profile = gantry_profile()
    cameras = {
        role: camera
        for role, name in CAMERAS.items()
        if (camera := profile.camera(name)) is not None
    }
    observations = Observations(run.files, cameras, frozenset(), profile)
    assert observations.gaps.without_image == 15
    assert len(list(observations)) == 1


def test_the_first_divergence_is_named_and_plotted(tmp_path: Path) -> None:
    found = replayed(
        record_run(store_in(tmp_path), "demo", INSTRUCTIONS), Recomputing(wrong_from=5)
    )
    comparison = compare(found, EXACT)
    assert (comparison.diverging, comparison.first) == (11, 5)
    np.testing.assert_allclose(comparison.largest[2], 0.004, atol=1e-12)
    assert comparison.largest[[0, 1, 3, 4, 5, 6]].max() == 0.0
    text = describe(comparison, found)
    assert "the first is number 5, 0.50 s after the beginning ('pick up the cup')" in text
    assert f"Row 0, {AXES[2]}: 0.01 -> 0.014" in text
    write_report(tmp_path / "out", found, comparison)
    told = json.loads((tmp_path / "out/comparison.json").read_text())
    assert told["first_divergence"] == 5
    assert (tmp_path / "out/comparison.png").stat().st_size > 10_000


def test_a_refusal_is_a_divergence(tmp_path: Path) -> None:
    found = replayed(record_run(store_in(tmp_path), "demo", INSTRUCTIONS), Recomputing(refuses=3))
    comparison = compare(found, 1.0)
    assert comparison.first == 3
    assert "There is no cup." in describe(comparison, found)


def test_a_run_without_predictions_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    file = RunFile(path, {})
    file.write(Record("/told", "std_msgs/msg/String", 1, 1, 1, to_string("nothing")))
    file.finish()
    with pytest.raises(InvalidInputError, match="holds no predictions"):
        Observations([path], {}, frozenset(), gantry_profile())
