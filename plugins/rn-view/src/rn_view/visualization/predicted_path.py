"""TCP path that the running action chunk leads to, for the scene. Computed from the chunk, before
the limits of control.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from roboneuron import (
    ACTION_LABEL,
    ForeignDataError,
    InvalidInputError,
    channel_keys,
    foreign,
)

F64 = NDArray[np.float64]
Forward = Callable[[Mapping[str, float]], Mapping[str, F64]]
"""Joint positions by name -> pose (4, 4) of the TCP of each arm."""
_MOST_ROWS = 256
_MOST_READ = 4096
_MOST_POSTURES = 16
"""Each takes about a millisecond."""
_KEPT_S = 1.0
"""A path is shown for this time after its last row was due."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlannedChunk:
    """An action chunk, and the state that it starts from.

    Attributes:
        at_s: time of arrival [s], as `Source.now_s`.
        label: of its control space.
        rows: float64 (k, n).
        step_s: time between rows [s].
        starts_m: TCP of each arm in the observation [m]; empty if unknown.
        joints: joint positions in the observation, by name.
    """

    at_s: float
    label: str
    rows: F64
    step_s: float
    starts_m: Mapping[str, F64]
    joints: Mapping[str, float]

    @classmethod
    def parse(cls, text: str, at_s: float) -> PlannedChunk | None:
        """Parse a message of the recorder's topic `predictions`; None for a failed prediction and
        for any other text.
        """
        try:
            told = foreign.table(foreign.decode_json(text, "a prediction"), "a prediction")
            label = foreign.text(told.get("space"), "space", 4096)
            width = len(channel_keys(label))
            rows = [
                foreign.numbers(row, "a row", width)
                for row in foreign.items(told.get("rows"), "rows", most=_MOST_READ)
            ]
            arms = foreign.table(told.get("arms") or {}, "arms", 8)
            if not arms and told.get("ee_pose"):
                arms = {"": told["ee_pose"]}
            joints = told.get("joints") or {"names": [], "position": []}
            names = foreign.items(foreign.field(joints, "names"), "names", most=256)
            chunk = cls(
                at_s=at_s,
                label=label,
                rows=np.array(rows[:_MOST_ROWS], dtype=np.float64).reshape(-1, width),
                step_s=foreign.number(told.get("step_s"), "step_s", 0.0),
                starts_m={
                    name: np.array(foreign.numbers(foreign.field(arm, "position_m"), name, 3))
                    for name, arm in arms.items()
                },
                joints=dict(
                    zip(
                        [foreign.text(name, "a joint") for name in names],
                        foreign.numbers(foreign.field(joints, "position"), "position", len(names)),
                        strict=True,
                    )
                ),
            )
        except (ForeignDataError, InvalidInputError):
            return None
        return chunk

    def is_over(self, now_s: float) -> bool:
        """Whether its last row was due more than a second ago."""
        return not 0.0 <= now_s - self.at_s <= len(self.rows) * self.step_s + _KEPT_S

    def paths(self, forward: Forward | None) -> dict[str, F64]:
        """TCP positions [m] (k, 3) of each arm; without the arms for which they cannot be computed.

        Args:
            forward: forward kinematics; None without a robot model.
        """
        kind = self.label.partition(":")[0].partition("@")[0]
        keys = channel_keys(self.label)
        if self.label == ACTION_LABEL or kind == "ee_delta":
            return self._sums(keys)
        if kind == "ee_pose":
            return _columns(keys, self.rows, ("x", "y", "z"))
        if forward is None:
            return {}
        return self._followed(kind, keys, forward)

    def _sums(self, keys: tuple[str, ...]) -> dict[str, F64]:
        moves = _columns(keys, self.rows, ("dx_m", "dy_m", "dz_m"))
        return {
            arm: np.vstack([self.starts_m[arm], self.starts_m[arm] + np.cumsum(steps, axis=0)])
            for arm, steps in moves.items()
            if arm in self.starts_m
        }

    def _followed(self, kind: str, keys: tuple[str, ...], forward: Forward) -> dict[str, F64]:
        names = [key.rpartition("/")[2] for key in keys]
        columns = [i for i, name in enumerate(names) if name in self.joints]
        start = np.array([self.joints[names[i]] for i in columns])
        rows = self.rows[:, columns]
        if kind == "joint_delta":
            rows = start + rows
        elif kind == "joint_velocity":
            rows = start + np.cumsum(rows * self.step_s, axis=0)
        if not columns:
            return {}
        found: dict[str, list[F64]] = {}
        for row in rows[:: 1 + len(rows) // _MOST_POSTURES]:
            own = {names[i]: float(value) for i, value in zip(columns, row, strict=True)}
            for arm, pose in forward({**self.joints, **own}).items():
                found.setdefault(arm, []).append(pose[:3, 3])
        return {arm: np.array(points) for arm, points in found.items()}


def _columns(keys: tuple[str, ...], rows: F64, names: tuple[str, ...]) -> dict[str, F64]:
    """Columns with these names, by arm."""
    arms = dict.fromkeys(key.rpartition("/")[0] for key in keys)
    found: dict[str, F64] = {}
    for arm in arms:
        wanted: list[Any] = [f"{arm}/{name}" if arm else name for name in names]
        if all(key in keys for key in wanted):
            found[arm] = rows[:, [keys.index(key) for key in wanted]]
    return found
