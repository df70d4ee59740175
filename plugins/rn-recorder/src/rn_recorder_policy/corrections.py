"""Errors of single channels: sign, unit, scale, offset, or an inverted gripper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_recorder_policy.answers import Answers
from rn_recorder_policy.losses import FLOOR, LEAST_PAIRS, loss_of, pairs

F64 = NDArray[np.float64]
DEGREES = 180.0 / np.pi
_FACTORS = {
    "rad": (DEGREES, 1.0 / DEGREES),
    "rad/s": (DEGREES, 1.0 / DEGREES),
    "m": (1000.0, 0.001, 100.0, 0.01),
    "m/s": (1000.0, 0.001, 100.0, 0.01),
    "opening": (100.0, 0.01),
    "1": (),
}
"""Ratios of commonly confused units."""
_TOLERATED = (0.7, 1.4)
"""Scales of a correctly configured policy that is too cautious or too aggressive."""
_LEAST_OFFSET = 0.2
"""Smaller offsets, as fractions of the spread, are the policy's own."""
_LARGEST_LOSS = 0.4
_LEAST_RATIO = 4.0
"""Minimum factor by which a correction has to reduce the loss."""
_AS_GOOD = 0.5
"""A simpler correction is preferred if the best one is better by at most this, in logarithms."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ChannelCorrection:
    """Relation of one channel's answers to the expected ones: `scale * expected + offset`.

    Attributes:
        kind: "sign", "degrees", "scale", "offset", "gripper", "statistics" (scale and offset).
        loss: the remaining loss, as a fraction of the variance.
    """

    kind: str
    scale: float
    offset: float
    loss: float


def correction_of(
    answers: Answers, expected: F64, channel: int, loss: float
) -> ChannelCorrection | None:
    """The simplest correction that explains the answers of a channel; None if none is necessary or
    sufficient.

    Args:
        answers: those of the backend.
        expected: float64 (N, K, C).
        channel: number of the channel.
        loss: loss of the channel without correction.
    """
    size = answers.space.size
    least = float(answers.least_spreads(expected.reshape(-1, size))[channel])
    p, e = pairs(answers.predicted[..., channel].ravel(), expected[..., channel].ravel())
    if len(p) < LEAST_PAIRS or not np.isfinite(loss):
        return None
    is_gripper = bool(answers.is_gripper[channel])
    unit = answers.space.channels[channel].unit
    candidates = []
    for kind, scale, offset in _candidates(p, e, least, unit, is_gripper):
        left = loss_of(p, scale * e + offset, least * min(1.0, abs(scale)))
        candidates.append(ChannelCorrection(kind=kind, scale=scale, offset=offset, loss=left))
    if not candidates:
        return None
    best = min(float(np.log(c.loss + FLOOR)) for c in candidates)
    found = next(c for c in candidates if np.log(c.loss + FLOOR) <= best + _AS_GOOD)
    if found.loss > _LARGEST_LOSS or (loss + FLOOR) < _LEAST_RATIO * (found.loss + FLOOR):
        return None
    return found


def _candidates(
    p: F64, e: F64, least: float, unit: str, is_gripper: bool
) -> list[tuple[str, float, float]]:
    """Kind, scale and offset of possible corrections, simplest first."""
    spread = float(e.std())
    shift = float((p - e).mean())
    found: list[tuple[str, float, float]] = []
    if spread < least:
        # it hardly moves: sign and scale are undetermined
        if is_gripper and abs(float((p + e).mean()) - 1.0) < _LEAST_OFFSET:
            found.append(("gripper", -1.0, 1.0))
        elif abs(shift) > 2.0 * least:
            found.append(("offset", 1.0, shift))
        return found
    found.append(("gripper", -1.0, 1.0) if is_gripper else ("sign", -1.0, 0.0))
    for factor in _FACTORS[unit]:
        found.append(("degrees" if unit.startswith("rad") else "scale", factor, 0.0))
    if abs(shift) > _LEAST_OFFSET * spread:
        found.append(("offset", 1.0, shift))
    through_zero = float(p @ e) / float(e @ e)
    if through_zero > 0.0 and not _TOLERATED[0] <= through_zero <= _TOLERATED[1]:
        found.append(("scale", through_zero, 0.0))
    slope = float(((p - p.mean()) * (e - e.mean())).mean()) / spread**2
    offset = float(p.mean() - slope * e.mean())
    is_wrong = not _TOLERATED[0] <= slope <= _TOLERATED[1]
    if slope != 0.0 and (is_wrong or abs(shift) > _LEAST_OFFSET * spread):
        found.append(("statistics", slope, offset))
    return found
