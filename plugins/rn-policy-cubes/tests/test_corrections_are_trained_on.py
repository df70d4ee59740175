"""Only rows corrected by a person become labels of the named cube."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rn_policy_cubes import corrections
from rn_policy_cubes.corrections import CAMERA, corrections_in, take_corrections
from rn_policy_cubes.dataset import Shards, draw, sampling
from rn_policy_cubes.demonstrations import COLOURS
from rn_policy_cubes.losses import Helpers, losses
from rn_policy_cubes.network import CubesNetwork
from rn_policy_cubes.packing import Card, Packed
from rn_policy_cubes.recipe import ACTION_SCALE, ROWS, Recipe
from rn_policy_cubes.training import train
from rn_policy_cubes.words import Prompts
from roboneuron import InvalidInputError

demonstration = pytest.importorskip("rn_recorder_policy.demonstration")
FIRST, LAST, COUNT, RESTS = 4, 15, 20, 4
GREEN = COLOURS.index("green")


def episode() -> demonstration.Demonstration:
    """Twenty rows; a person acts in rows 4 to 14, and rests in the last four of them."""
    action = np.tile([0.02, 0, -0.01, 0, 0, 0.1, 1.0], (COUNT, 1))
    action[:, 0] += 1e-3 * np.arange(COUNT)
    action[LAST - RESTS : LAST, :6] = 0.0
    led = ((np.arange(COUNT) >= FIRST) & (np.arange(COUNT) < LAST)).astype(float)
    pose = np.tile([0.5, 0.1, 0.2, 1.0, 0, 0, 0], (COUNT, 1))
    state = np.full((COUNT, 2), 0.02)

    def read_pictures(camera: str, rows: Sequence[int]) -> list[np.ndarray]:
        assert camera == CAMERA
        return [np.full((224, 224, 3), row, dtype=np.uint8) for row in rows]

    column = demonstration.Column
    return demonstration.Demonstration(
        source="episode 0",
        fps=10.0,
        instruction="pick up the green cube",
        columns={
            "action": column(names=None, values=action),
            "intervention": column(names=None, values=led[:, None]),
            "observation.ee_pose": column(names=None, values=pose),
            "observation.state": column(names=("joint", "fr3_finger_joint1"), values=state),
        },
        cameras=(CAMERA,),
        read_pictures=read_pictures,
    )


@pytest.fixture
def dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder whose one episode is `episode()`."""
    monkeypatch.setattr(corrections, "_episodes", lambda path: iter([episode()]))
    path = tmp_path / "fixed"
    (path / "data").mkdir(parents=True)
    (path / "data" / "file.parquet").write_bytes(b"rows")
    return path


def test_a_correction_labels_the_named_cube_alone(dataset: Path, tmp_path: Path) -> None:
    name = take_corrections(tmp_path, dataset)
    (shards,) = corrections_in(tmp_path, [name])
    # whole chunks in which the person rests in at most one row
    chosen = range(FIRST, LAST - RESTS + 2 - ROWS)
    assert len(shards) == len(chosen)
    labels = shards.labels
    assert labels.known.sum() == len(chosen)
    assert labels.known[:, GREEN].all()
    expected = episode().columns["action"].values
    for view, first in enumerate(chosen):
        assert (shards.patches[view] == first).all()
        told = labels.actions[view, GREEN].astype(np.float64)
        told[:, :6] *= ACTION_SCALE
        # float32
        np.testing.assert_allclose(told, expected[first : first + ROWS], atol=1e-7)
    assert not labels.is_placed.any()
    # half open, at y = 0.1 of -0.35 .. 0.35
    assert labels.state[0, 6] == pytest.approx(0.0, abs=1e-6)
    assert labels.state[0, 1] == pytest.approx(0.1 / 0.35, abs=1e-6)


def test_a_pause_of_the_person_is_no_correction(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paused = episode()
    # samples that came late: the arm is braked in every second row
    paused.columns["action"].values[FIRST:LAST:2, :6] = 0.0
    monkeypatch.setattr(corrections, "_episodes", lambda path: iter([paused]))
    with pytest.raises(InvalidInputError, match="no row from which a person corrected"):
        take_corrections(tmp_path, dataset)


def test_a_gripper_that_closes_is_a_correction(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closing = episode()
    closing.columns["action"].values[FIRST:LAST, :6] = 0.0
    closing.columns["action"].values[FIRST + 1 : LAST, 6] = 0.0
    closing.columns["observation.state"].values[FIRST + 1 : LAST, 1] -= 0.002 * np.arange(10)
    monkeypatch.setattr(corrections, "_episodes", lambda path: iter([closing]))
    (shards,) = corrections_in(tmp_path, [take_corrections(tmp_path, dataset)])
    # the opening changes until the row before the last one, and after the first one
    assert len(shards) == LAST - FIRST - ROWS + 1
    assert (shards.labels.actions[-1, GREEN, :, 6] == 0.0).all()


def test_the_same_data_set_is_taken_once(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = take_corrections(tmp_path, dataset)
    monkeypatch.setattr(corrections, "_episodes", None)
    assert take_corrections(tmp_path, dataset) == name


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"fps": 30.0}, "30 rows a second"),
        ({"instruction": "tidy up"}, "names no cube"),
        ({"instruction": "put the red cube on the green cube"}, "names no cube"),
        ({"cameras": ("observation.images.hand",)}, "lacks observation.images.front"),
        ({"read_pictures": lambda camera, rows: [np.zeros((64, 96, 3))] * len(rows)}, "96x64 px"),
    ],
)
def test_another_data_set_is_refused(
    dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    change: dict[str, object],
    told: str,
) -> None:
    changed = replace(episode(), **change)  # type: ignore[arg-type]
    monkeypatch.setattr(corrections, "_episodes", lambda path: iter([changed]))
    with pytest.raises(InvalidInputError, match=told):
        take_corrections(tmp_path, dataset)


def test_a_data_set_without_corrections_is_refused(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(corrections, "_episodes", lambda path: iter(()))
    with pytest.raises(InvalidInputError, match="no row from which a person corrected"):
        take_corrections(tmp_path, dataset)


def test_only_actions_of_a_correction_are_learnt(
    dataset: Path, tmp_path: Path, network: CubesNetwork, recipe: Recipe, prompts: Prompts
) -> None:
    (shards,) = corrections_in(tmp_path, [take_corrections(tmp_path, dataset)])
    batch = draw(shards, prompts, sampling(shards), 3, 20, [1])
    thought = network(batch.look, batch.state, batch.ids)
    helpers = Helpers(recipe.shape)
    found = losses(thought, helpers, batch)
    assert (found.spot.item(), found.place.item()) == (0.0, 0.0)
    named = thought.actions.detach().clone().requires_grad_()
    error = losses(replace(thought, actions=named), helpers, batch).action
    error.backward()
    touched = named.grad.abs().sum(dim=(1, 2)).view(3, len(COLOURS)) > 0
    assert touched[:, GREEN].all()
    assert touched.sum() == 3


@pytest.mark.exhaustive
def test_a_training_goes_on_from_weights_with_corrections(
    dataset: Path,
    tmp_path: Path,
    network: CubesNetwork,
    recipe: Recipe,
    shards: Path,
) -> None:
    found = corrections_in(tmp_path, [take_corrections(tmp_path, dataset)])
    packed = Packed.of(network, Card(recipe=recipe, step=0, cpu_s=0.0))
    going_on = recipe.model_copy(update={"continues": True, "rate": 0.0})

    def run(name: str, corrections: Sequence[Shards]) -> torch.Tensor:
        training = train(
            going_on,
            tmp_path / name,
            shards,
            weights=packed,
            corrections=corrections,
            say=lambda line: None,
        )
        return training.network.head.fc2.weight.detach()

    # the rate is zero, so the final weights are the initial ones
    assert torch.equal(run("still", found), packed.tensors["action_head.fc2.weight"])
