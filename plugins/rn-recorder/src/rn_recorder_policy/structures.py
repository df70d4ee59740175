"""Hypotheses on configuration errors of answers as a whole: shifted, at another rate, in another
frame, relative or absolute, with another order of channels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_recorder_policy.answers import Answers, interpolated
from rn_recorder_policy.losses import FLOOR, LEAST_PAIRS, loss_of

F64 = NDArray[np.float64]
MOST_SHIFT = 10
"""Largest shift in rows by which answers are searched in the recording."""
_STRETCHES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
_LEAST_TURN_RAD = np.radians(10.0)
_LARGEST_LOSS = 0.4
"""A channel with a larger loss does not contain the values of the other one."""
_LEAST_GAIN = 0.5
"""Minimum gain, in logarithms, of an exchange of two channels: still channels are all alike."""


@dataclass(frozen=True, kw_only=True)
class Structure:
    """One possible difference between the answers as a whole and the recording.

    Attributes:
        kind: kind of the fault; "" for none.
        text: description, as a clause.
        expected: float64 (N, K, C), the answers in that case; NaN if unknown.
        channels: numbers of the changed channels.
        cost: minimum gain of an explanation by it, in the mean logarithm of the losses.
    """

    kind: str
    text: str
    expected: F64
    channels: tuple[int, ...]
    cost: float


def structures(answers: Answers) -> Iterator[Structure]:
    """Yield every structure that can be evaluated, the correct configuration first."""
    same = answers.expected()
    every = tuple(range(answers.space.size))
    yield Structure(kind="", text="", expected=same, channels=(), cost=0.0)
    for shift in (*range(-MOST_SHIFT, 0), *range(1, MOST_SHIFT + 1)):
        where = "later" if shift > 0 else "earlier"
        yield Structure(
            kind="shifted",
            text=f"the answers are those that belong {abs(shift)} rows {where}",
            expected=answers.expected(shift=shift),
            channels=every,
            cost=0.1,
        )
    yield from _rates(answers)
    yield from _relative(answers, same)
    if answers.space.kind == "ee_delta":
        yield from _frames(answers, same)
    swapped = _swapped(answers, same)
    if swapped is not None:
        yield swapped


def _rates(answers: Answers) -> Iterator[Structure]:
    if answers.horizon < 2 and answers.stretch == 1.0:
        return
    factors = {factor * answers.stretch for factor in _STRETCHES} if answers.horizon > 1 else set()
    for stretch in sorted(factors | {1.0}):
        if stretch == answers.stretch:
            continue
        yield Structure(
            kind="rate",
            text=f"the rows are those of {answers.fps / stretch:.3g} Hz; the backend says "
            f"{1.0 / answers.step_s:.3g} Hz, the data set has {answers.fps:.3g} Hz",
            expected=answers.expected(stretch),
            channels=tuple(range(answers.space.size)),
            cost=0.1,
        )


def _relative(answers: Answers, same: F64) -> Iterator[Structure]:
    if answers.space.kind == "ee_delta":
        yield from _relative_poses(answers, same)
        return
    known = np.isfinite(answers.joints).all(axis=0) & ~answers.is_gripper
    if not known.any() or answers.space.kind not in ("joint_position", "joint_velocity"):
        return
    channels = tuple(int(c) for c in np.flatnonzero(known))
    start = answers.joints[answers.frames][:, None, :]
    if answers.space.kind == "joint_velocity":
        rows = answers.rows_at(answers.stretch)
        yield Structure(
            kind="absolute_for_relative",
            text="the answers are joint positions, taken as velocities",
            expected=np.where(known, interpolated(answers.joints, rows), same),
            channels=channels,
            cost=0.1,
        )
        return
    before = answers.expected(shift=-1.0)
    for kind, text, expected in (
        (
            "relative_for_absolute",
            "the answers are relative to the measured joints, taken as positions",
            same - start,
        ),
        (
            "absolute_for_relative",
            "the answers have the measured joints added, to positions that are absolute already",
            same + start,
        ),
        (
            "relative_for_absolute",
            "the answers are differences from row to row, taken as positions",
            same - before,
        ),
    ):
        yield Structure(
            kind=kind,
            text=text,
            expected=np.where(known, expected, same),
            channels=channels,
            cost=0.1,
        )


def _relative_poses(answers: Answers, same: F64) -> Iterator[Structure]:
    motion = ~answers.is_gripper
    sums = np.cumsum(same, axis=1)
    if answers.horizon > 1:
        yield Structure(
            kind="relative_to_start",
            text="each row counts from the begin of its chunk, not from the row before",
            expected=np.where(motion, sums, same),
            channels=tuple(int(c) for c in np.flatnonzero(motion)),
            cost=0.1,
        )
    if answers.positions_m is None:
        return
    start = np.zeros_like(same)
    start[..., :3] = answers.positions_m[answers.frames][:, None, :]
    moved = (0, 1, 2)
    is_moved = np.isin(np.arange(answers.space.size), moved)
    # the notation of an absolute rotation is unknown
    rest = np.where(motion, np.nan, same)
    for kind, text, expected in (
        (
            "absolute_for_relative",
            "the answers are positions of the TCP, taken as displacements",
            sums + start,
        ),
        (
            "relative_for_absolute",
            "the answers are displacements, the recorded actions are positions of the TCP",
            same - start,
        ),
    ):
        yield Structure(
            kind=kind,
            text=text,
            expected=np.where(is_moved, expected, rest),
            channels=moved,
            cost=0.1,
        )


def _frames(answers: Answers, same: F64) -> Iterator[Structure]:
    """Displacements of the TCP in another frame than the recording's."""
    motion = tuple(range(6))

    def turned(rotation: F64) -> F64:
        """Rotate by (3, 3), or by (N, 1, 3, 3)."""
        expected = same.copy()
        for part in (slice(0, 3), slice(3, 6)):
            expected[..., part] = (rotation @ same[..., part, None])[..., 0]
        return expected

    if answers.orientations is not None:
        here = answers.orientations[answers.frames][:, None]
        to_tcp = np.swapaxes(here, -1, -2)
        for text, turn in (
            ("the answers are in the frame of the TCP, the recording in that of the base", to_tcp),
            ("the answers are in the frame of the base, the recording in that of the TCP", here),
        ):
            yield Structure(
                kind="frame",
                text=text,
                expected=turned(turn),
                channels=motion,
                cost=0.12,
            )
    rotation, angle_rad = _rotation_between(answers, same)
    if angle_rad > _LEAST_TURN_RAD:
        yield Structure(
            kind="frame",
            text=f"the answers are in a frame that is turned by {np.degrees(angle_rad):.0f} deg",
            expected=turned(rotation),
            channels=motion,
            cost=0.2,
        )


def _rotation_between(answers: Answers, same: F64) -> tuple[F64, float]:
    """The rotation that best maps recorded displacements to answered ones, and its angle.

    Source: Kabsch, 1976: by the singular value decomposition of the covariance.
    """
    covariance = np.zeros((3, 3))
    for part in (slice(0, 3), slice(3, 6)):
        e, p = same[..., part].reshape(-1, 3), answers.predicted[..., part].reshape(-1, 3)
        known = np.isfinite(e).all(axis=1)
        size = float(np.linalg.norm(e[known])) * float(np.linalg.norm(p[known]))
        if known.sum() >= LEAST_PAIRS and size > 0.0:
            covariance += p[known].T @ e[known] / size
    left, _, right = np.linalg.svd(covariance)
    handed = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right)) or 1.0])
    rotation = left @ handed @ right
    return rotation, float(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0)))


def _swapped(answers: Answers, same: F64) -> Structure | None:
    """The order of channels that explains the answers best; None if it is the correct one."""
    size = answers.space.size
    least = answers.least_spreads(same.reshape(-1, size))
    costs = np.array(
        [
            [
                loss_of(answers.predicted[..., c].ravel(), same[..., r].ravel(), float(least[r]))
                for r in range(size)
            ]
            for c in range(size)
        ]
    )
    costs = np.log(np.nan_to_num(costs, nan=1.0) + FLOOR)
    order = [r if costs[c, r] < np.log(_LARGEST_LOSS) else c for c, r in _best_order(costs)]
    moved = tuple(c for c in range(size) if order[c] != c)
    if not moved:
        return None
    keys = answers.space.keys
    told = ", ".join(f"{keys[c]} has the values of {keys[order[c]]}" for c in moved)
    return Structure(
        kind="swapped",
        text=told,
        expected=same[..., order],
        channels=moved,
        cost=0.08 * (len(moved) - 1),
    )


def _best_order(costs: F64) -> list[tuple[int, int]]:
    """Pairs of row and column with a small sum of costs, found by improving exchanges of two."""
    order = list(range(len(costs)))
    helps = True
    while helps:
        helps = False
        for i in range(len(order)):
            for j in range(i + 1, len(order)):
                now = costs[i, order[i]] + costs[j, order[j]]
                if costs[i, order[j]] + costs[j, order[i]] < now - _LEAST_GAIN:
                    order[i], order[j] = order[j], order[i]
                    helps = True
    return list(enumerate(order))
