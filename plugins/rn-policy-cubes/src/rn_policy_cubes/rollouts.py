"""Rollouts of a trained policy in the simulated cell: views of the states that the policy itself
reaches, labelled by the teacher (DAgger). They are stored as shards like demonstrations.

Source: Ross, Gordon and Bagnell 2011, "A reduction of imitation learning and structured prediction
to no-regret online learning".
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from rn_policy_cubes.demonstrations import (
    COLOURS,
    ShardRecorder,
    fill_shard,
    shard_files,
    situations,
)
from rn_policy_cubes.labels import patches_of, state_of
from rn_policy_cubes.network import Look
from rn_policy_cubes.packing import Packed, network_of
from rn_policy_cubes.recipe import ACTION_SCALE, PATCHES, ROWS
from rn_policy_cubes.teacher import act
from rn_policy_cubes.words import read_prompts
from rn_robot_fr3.simulation import ArmSimulation

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

SHARDS_PER_ROUND = 10_000
"""Rollouts of round n have numbers from n times this value on; lower numbers are demonstrations."""
_STEPS, _CORRECTED_FROM = 100, 65
"""Actions of an episode; from the second value on the teacher acts, which demonstrates recovery."""
_FEW_BETWEEN, _CORRECTED_SHARE, _HARD = 0.15, 0.5, 0.5
"""Fractions: of the steps between two predictions that are recorded too; of the recorded steps
under the teacher; of the episodes in which the cube with the largest turn is named.
"""


class Student:
    """A trained policy, run in this process. Used from one thread."""

    def __init__(self, packed: Packed, tokenizer: Path) -> None:
        self._network = network_of(packed).eval()
        self._ids = torch.from_numpy(read_prompts(tokenizer).by_length[0][0])
        self._index = torch.arange(PATCHES)[None]

    @torch.no_grad()
    def predict(self, picture: U8, row: NDArray[np.void], colour: str) -> F64:
        """Predict the next actions, float64 (ROWS, 7), in the teacher's units.

        Args:
            picture: uint8 (224, 224, 3) RGB.
            row: state of the dtype `ROW`, (); only the robot's measurements are used.
            colour: colour of the named cube.
        """
        look = Look(torch.from_numpy(patches_of(picture[None])), self._index, None)
        state = torch.from_numpy(state_of(row))[None]
        ids = self._ids[None, COLOURS.index(colour)][None]
        actions = self._network(look, state, ids).actions[0].double().numpy()
        actions[:, :6] *= ACTION_SCALE
        actions[:, 6] = np.clip(actions[:, 6], 0.0, 1.0)
        assert actions.shape[0] == ROWS
        return np.asarray(actions)


class RolloutRecorder(ShardRecorder):
    """Lets the student act, and then the teacher if the cube was not lifted in time."""

    def __init__(self, number: int, views: int, student: Student) -> None:
        super().__init__(number, views)
        self._student = student

    def choose(self, simulation: ArmSimulation) -> str:
        """Often choose the cube with the largest turn, on which this policy tends to fail."""
        row = self.look(simulation, COLOURS[0])[None]
        turns = [abs(float(situations(row, cube).turn_rad[0])) for cube in range(len(COLOURS))]
        if self.random.random() < _HARD:
            return COLOURS[int(np.argmax(turns))]
        return super().choose(simulation)

    def pick(self, simulation: ArmSimulation, target: str) -> None:
        """Run one episode from the arm's present position."""
        cube, planned, held_steps = COLOURS.index(target), np.zeros((0, 7)), 0
        for step in range(_STEPS):
            held_steps += simulation.cubes()[target].held_s > 0.5
            if held_steps > 3 or self.is_full:
                return
            row = self.look(simulation, target)
            is_corrected = step >= _CORRECTED_FROM
            share = _CORRECTED_SHARE if is_corrected else _FEW_BETWEEN
            is_asked = not is_corrected and not len(planned)
            picture: U8 | None = None
            if is_asked or self.random.random() < share:
                picture = self.keep(simulation, target)
            if is_corrected:
                planned = act(situations(row[None], cube))
            elif is_asked:
                assert picture is not None, "the shard was not full above"
                planned = self._student.predict(picture, row, target)
            self.execute(simulation, planned[0])
            planned = planned[1:]


def write_rollouts(directory: Path, number: int, views: int, student: Student) -> tuple[int, int]:
    """Create shard `number`; returns the number of episodes that lifted the cube, and of all
    episodes.
    """
    return fill_shard(directory, RolloutRecorder(number, views, student))


def _main(directory: str, weights: str, tokenizer: str, views: str, *numbers: str) -> None:
    torch.set_num_threads(1)
    student = Student(Packed.read(Path(weights)), Path(tokenizer))
    for number in map(int, numbers):
        if not shard_files(Path(directory), number)[0].exists():
            lifted, episodes = write_rollouts(Path(directory), number, int(views), student)
            print(number, lifted, episodes, flush=True)


if __name__ == "__main__":
    _main(*sys.argv[1:])
