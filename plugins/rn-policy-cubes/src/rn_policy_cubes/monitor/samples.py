"""Recorded episodes as the network's input and labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_policy_cubes.demonstrations import SIDE_PX
from rn_policy_cubes.monitor.episodes import InjectedEpisode, read_episode
from rn_policy_cubes.monitor.layers import state_of
from rn_policy_cubes.monitor.views import close_view, whole_view
from rn_robot_fr3.cameras import cameras
from rn_simulation.ground_truth import HELD_M, LIFTED_M

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
_OPEN = 0.9
_REACH_M = 0.5
_UP_M, _AWAY_M = 0.14, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Views of episodes, n of them, with labels for each of c colours.

    Attributes:
        close, whole: uint8 (n, 48, 48, 3) and (n, 56, 56, 3).
        state: float32 (n, 4), as `layers.state_of`.
        labels: float32 (n, 3, c), in the order of `layers.OUTPUTS`.
        known: float32 (n, 3, c), 1 where the label can be seen.
    """

    close: U8
    whole: U8
    state: F32
    labels: F32
    known: F32

    @classmethod
    def of(cls, recording: InjectedEpisode) -> Samples:
        """The views of an episode."""
        calibration = cameras()[0].calibration(SIDE_PX, SIDE_PX)
        views, pictures = recording.views, recording.pictures
        pairs = list(zip(pictures, views["tcp_m"], strict=True))
        hidden = views["is_hidden"]
        labels = _labels(views)
        labels[hidden, 0] = 0.0
        known = np.ones_like(labels)
        known[hidden, 1:] = 0.0
        return cls(
            close=np.stack([close_view(picture, calibration, tcp) for picture, tcp in pairs]),
            whole=np.stack([whole_view(picture) for picture in pictures]),
            state=state_of(views["tcp_m"], views["opening"]),
            labels=labels,
            known=known,
        )

    @classmethod
    def read(cls, paths: Sequence[Path]) -> Samples:
        """The views of several files; a frozen camera teaches nothing and is left out."""
        recordings = (read_episode(path) for path in paths)
        parts = [cls.of(made) for made in recordings if made.kind != "frozen"]
        return cls(
            **{
                field.name: np.concatenate([getattr(part, field.name) for part in parts])
                for field in fields(cls)
            }
        )

    def __len__(self) -> int:
        return len(self.close)


def _labels(views: NDArray[np.void]) -> F32:
    """Labels (n, 3, c) of views.

    Progress is up to a half for the way to the cube, 0.6 with the hand closed on it, and the rest
    for the height.
    """
    lifted, far = views["lifted_m"], views["distance_m"]
    closed = (views["opening"] < _OPEN)[:, None]
    is_held = (far < HELD_M) & closed
    height = np.clip(lifted / LIFTED_M, 0.0, 1.0)
    progress = np.where(is_held, 0.6 + 0.4 * height, 0.5 * (1.0 - np.minimum(1.0, far / _REACH_M)))
    up = (views["tcp_m"][:, 2] > _UP_M)[:, None]
    missing = up & closed & (far > _AWAY_M)
    stacked = np.stack([(lifted >= LIFTED_M) & (far < HELD_M), progress, missing], axis=1)
    return stacked.astype(np.float32)
