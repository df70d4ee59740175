"""Human corrections, from data sets in the layout of LeRobot v3, as views for training."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rn_policy_cubes.dataset import Shards
from rn_policy_cubes.demonstrations import COLOURS, ROW, SIDE_PX
from rn_policy_cubes.labels import PLACE_WIDTH, Labels, coloured_share, patches_of, state_of
from rn_policy_cubes.recipe import ACTION_SCALE, ACTION_WIDTH, ROWS
from rn_policy_cubes.replacing import replacing
from rn_policy_cubes.teacher import STEP_S
from rn_robot_fr3.profile import profile
from roboneuron import (
    InvalidInputError,
    MissingDependencyError,
    install_command,
    matrix_from_quaternion,
)

if TYPE_CHECKING:
    from rn_recorder_policy.demonstration import Demonstration

F64 = NDArray[np.float64]

FOLDER = "corrections"
CAMERA = "observation.images.front"
_POSE, _STATE = "observation.ee_pose", "observation.state"
_RATE_SHARE = 0.2
"""Relative difference of a data set's rate from the policy's above which its actions differ."""
_STILL_M, _STILL_RAD = 1e-4, 1e-3
"""Commands below these values count as rest."""
_MOVING_OPENING = 0.01
"""Change of the opening within a row above which the gripper moves."""
_MOST_RESTS = 1
"""Most rows of a chunk in which neither arm nor gripper moves: a person who pauses, or whose
samples come late, demonstrates nothing.
"""


def take_corrections(directory: Path, dataset: Path) -> str:
    """Store the corrections of a data set below `directory`; returns their name for
    `corrections_in`. The same data set has the same name.

    Raises:
        InvalidInputError: it has no usable ones; the message gives the reason.
        MissingDependencyError: rn-recorder, or a library that it needs to read data sets, is not
            installed.
    """
    name = f"{dataset.name}-{_digest(dataset)}"
    target = directory / FOLDER / f"{name}.npz"
    if target.exists():
        return name
    parts = [part for demonstration in _episodes(dataset) for part in _views(demonstration)]
    if not parts:
        raise InvalidInputError(
            f"{dataset} has no row from which a person corrected for {ROWS} rows.",
            hint="Export the runs in which a person led the arm: roboneuron runs export --lerobot.",
        )
    rows, pictures, actions = (np.stack(column) for column in zip(*parts, strict=True))
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as unfinished, unfinished.open("wb") as file:
        np.savez(file, rows=rows, pictures=pictures, actions=actions)
    return name


def corrections_in(directory: Path, names: Sequence[str]) -> list[Shards]:
    """Views for training, of each stored data set."""
    found = []
    for name in names:
        with np.load(directory / FOLDER / f"{name}.npz") as file:
            found.append(_shards(file["rows"], file["pictures"], file["actions"]))
    return found


def _shards(rows: NDArray[np.void], pictures: NDArray[np.uint8], actions: F64) -> Shards:
    """Views with the only known label, that of the named cube."""
    count, colours = len(rows), len(COLOURS)
    normalised = np.zeros((count, colours, ROWS, ACTION_WIDTH), dtype=np.float32)
    normalised[np.arange(count), rows["target"]] = actions
    normalised[..., :6] /= np.array(ACTION_SCALE, dtype=np.float32)
    is_target = rows["target"][:, None] == np.arange(colours)
    labels = Labels(
        state=np.stack([state_of(row) for row in rows]),
        actions=normalised,
        place=np.zeros((count, colours, PLACE_WIDTH), dtype=np.float32),
        known=is_target,
        distance_m=np.full((count, colours), np.inf, dtype=np.float32),
        is_target=is_target,
        is_placed=np.zeros(count, dtype=bool),
    )
    patches = patches_of(pictures)
    return Shards(patches, coloured_share(patches), labels)


def _digest(dataset: Path) -> str:
    found = hashlib.sha256()
    for path in sorted(dataset.glob("data/**/*.parquet")):
        found.update(path.read_bytes())
    return found.hexdigest()[:12]


def _episodes(dataset: Path) -> Iterator[Demonstration]:
    try:
        from rn_recorder_policy.lerobot_reading import episode_count, read_lerobot  # heavy
    except ImportError as error:
        raise MissingDependencyError(
            "Corrections are read by rn-recorder, which is not installed.",
            hint=f"Run: {install_command('rn-recorder[export]')}.",
        ) from error
    for number in range(episode_count(dataset)):
        yield read_lerobot(dataset, number)


def _views(
    demonstration: Demonstration,
) -> Iterator[tuple[NDArray[np.void], NDArray[np.uint8], F64]]:
    """State, image (224, 224, 3) and actions (ROWS, 7) of each row that is a correction."""
    columns, source = demonstration.columns, demonstration.source
    absent = {"action", "intervention", _POSE, _STATE} - columns.keys()
    if absent or CAMERA not in demonstration.cameras:
        lacks = ", ".join(sorted(absent)) or CAMERA
        raise InvalidInputError(f"{source} lacks {lacks}; it is no recording of this policy.")
    if abs(demonstration.fps * STEP_S - 1.0) > _RATE_SHARE:
        raise InvalidInputError(
            f"{source} has {demonstration.fps:g} rows a second; an action of this policy lasts "
            f"{STEP_S} s.",
            hint="Record while this policy runs.",
        )
    named = [colour for colour in COLOURS if colour in demonstration.instruction.split()]
    if len(named) != 1:
        raise InvalidInputError(
            f"The instruction of {source}, {demonstration.instruction!r}, names no cube.",
            hint=f"It must name one of {', '.join(COLOURS)}.",
        )
    actions = columns["action"].values
    led = columns["intervention"].values[:, 0] > 0.5
    openings = _openings(demonstration)
    acts = led & _moves(actions, openings)
    starts = range(len(led) - ROWS + 1)
    chosen = [
        first
        for first in starts
        if led[first : first + ROWS].all()
        and np.count_nonzero(acts[first : first + ROWS]) >= ROWS - _MOST_RESTS
    ]
    pictures = demonstration.read_pictures(CAMERA, chosen) if chosen else []
    for first, picture in zip(chosen, pictures, strict=True):
        if picture.shape != (SIDE_PX, SIDE_PX, 3):
            raise InvalidInputError(
                f"Images of {source} are {picture.shape[1]}x{picture.shape[0]} px; the policy sees "
                f"{SIDE_PX}x{SIDE_PX}."
            )
        row = _state(demonstration, first, float(openings[first]))
        row["target"] = COLOURS.index(named[0])
        yield row, picture, actions[first : first + ROWS]


def _moves(actions: F64, openings: F64) -> NDArray[np.bool_]:
    """True for the rows (n,) in which the arm or the gripper moves."""
    arm = (np.abs(actions[:, :3]) > _STILL_M).any(axis=1)
    arm |= (np.abs(actions[:, 3:6]) > _STILL_RAD).any(axis=1)
    command, opening = actions[:, 6], openings
    gripper = np.abs(np.diff(command, prepend=command[:1])) > 0.5
    gripper |= np.abs(np.diff(opening, append=opening[-1:])) > _MOVING_OPENING
    return np.asarray(arm | gripper)


def _openings(demonstration: Demonstration) -> F64:
    """The measured opening of each row, float64 (n,)."""
    gripper, state = profile().gripper, demonstration.columns[_STATE]
    assert gripper is not None, "the FR3 has one"
    names = state.names or ()
    if gripper.joint not in names:
        raise InvalidInputError(
            f"{demonstration.source} has no joint {gripper.joint}; it is from another robot."
        )
    return np.array(
        [gripper.to_opening(float(value)) for value in state.values[:, names.index(gripper.joint)]]
    )


def _state(demonstration: Demonstration, number: int, opening: float) -> NDArray[np.void]:
    """The measured state in the form of a demonstration's row, of the dtype `ROW`, ()."""
    row = np.zeros((), dtype=ROW)
    pose = demonstration.columns[_POSE].values[number]
    row["tcp_m"], row["rotation"] = pose[:3], matrix_from_quaternion(pose[3:7])
    row["opening"] = opening
    return row
