"""Diagnosis of probable configuration errors: the simplest explanation for differences between
answers and a recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_recorder_policy.answers import Answers
from rn_recorder_policy.corrections import DEGREES, ChannelCorrection, correction_of
from rn_recorder_policy.losses import badness, losses_of
from rn_recorder_policy.structures import Structure, structures

F64 = NDArray[np.float64]
KINDS = (
    "swapped",
    "degrees",
    "sign",
    "offset",
    "scale",
    "gripper",
    "statistics",
    "rate",
    "relative_for_absolute",
    "absolute_for_relative",
    "relative_to_start",
    "frame",
    "shifted",
    "unexplained",
)
"""Kinds of faults."""
_COST = 0.08
_STATISTICS_COST = 0.2
_LEAST_GAIN = 0.1
"""Minimum gain of an explanation beyond its cost."""
_MOST_CHANNELS = 0.6
"""Fraction of channels with scale or offset from which the statistics of all are suspected."""
_FOLLOWS = 0.6
"""A moving channel with a larger loss does not follow the recording."""
_ALIKE = 0.1


@dataclass(frozen=True, kw_only=True, slots=True)
class WiringFault:
    """One probable configuration error.

    Attributes:
        kind: one of `KINDS`.
        channels: names of the affected channels.
        text: the finding, as a sentence.
        remedy: what to check.
    """

    kind: str
    channels: tuple[str, ...]
    text: str
    remedy: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Diagnosis:
    """Result of the diagnosis.

    Attributes:
        faults: empty if answers and recording agree.
        before, after: loss by channel, without and with the explanation, float64 (C,), 0 .. 1.
        expected: float64 (N, K, C), answers of a backend that repeats the recording.
    """

    faults: tuple[WiringFault, ...]
    before: F64
    after: F64
    expected: F64


@dataclass(frozen=True, kw_only=True, slots=True)
class _Explanation:
    structure: Structure
    corrections: Mapping[int, ChannelCorrection]
    losses: F64
    badness: float


def diagnose(answers: Answers) -> Diagnosis:
    """Compare answers with the recording, and explain the differences."""
    possible = list(structures(answers))
    same = possible[0]
    before = losses_of(answers, same.expected)
    explanations = [_explain(answers, structure, before) for structure in possible]
    best = min(explanations, key=lambda one: one.badness)
    judged = np.isfinite(before)
    if best.badness > badness(before[judged]) - _LEAST_GAIN:
        best = _Explanation(structure=same, corrections={}, losses=before, badness=0.0)
    touched = {*best.structure.channels, *best.corrections}
    silent = ~np.isfinite(best.structure.expected).any(axis=(0, 1))
    told = silent | np.isin(np.arange(answers.space.size), list(touched))
    faults = [
        *_faults_of(answers, best),
        *_declared_rate(answers),
        *_unexplained(answers, same.expected, best.losses, told),
    ]
    return Diagnosis(faults=tuple(faults), before=before, after=best.losses, expected=same.expected)


def _explain(answers: Answers, structure: Structure, before: F64) -> _Explanation:
    losses = losses_of(answers, structure.expected)
    # channels that a structure does not determine keep their loss
    losses = np.where(np.isfinite(losses), losses, before)
    found = {}
    for channel, loss in enumerate(losses):
        correction = correction_of(answers, structure.expected, channel, float(loss))
        if correction is not None:
            found[channel] = correction
            losses[channel] = correction.loss
    cost = structure.cost + sum(_cost(*group) for group in _groups(answers, found))
    judged = np.isfinite(before)
    return _Explanation(
        structure=structure,
        corrections=found,
        losses=losses,
        badness=badness(losses[judged]) + cost,
    )


def _cost(kind: str, channels: Sequence[int]) -> float:
    if kind == "statistics":
        return _STATISTICS_COST
    # signs are set individually, units and scales for all channels
    return _COST * (len(channels) if kind == "sign" else 1)


def _groups(
    answers: Answers, corrections: Mapping[int, ChannelCorrection]
) -> list[tuple[str, tuple[int, ...]]]:
    """Group corrections that are one fault, by kind, with their channels."""
    motion = np.flatnonzero(~answers.is_gripper)
    by_kind: dict[str, list[int]] = {}
    for channel, correction in corrections.items():
        by_kind.setdefault(correction.kind, []).append(channel)
    doubtful = [
        c
        for kind in ("offset", "scale", "statistics")
        for c in by_kind.get(kind, [])
        if not answers.is_gripper[c]
    ]
    scales = np.array([corrections[c].scale for c in doubtful])
    if len(doubtful) >= max(3.0, _MOST_CHANNELS * len(motion)) and not (
        all(corrections[c].kind == "scale" for c in doubtful) and _are_alike(scales)
    ):
        apart = [c for c in corrections if c not in doubtful]
        return [
            ("statistics", tuple(sorted(doubtful))),
            *_groups(answers, {c: corrections[c] for c in apart}),
        ]
    groups: list[tuple[str, tuple[int, ...]]] = []
    for kind, channels in by_kind.items():
        if kind in ("sign", "degrees", "gripper"):
            groups.append((kind, tuple(channels)))
        elif kind == "scale":
            groups += [(kind, alike) for alike in _of_equal_scale(channels, corrections)]
        else:
            groups += [(kind, (channel,)) for channel in channels]
    return groups


def _are_alike(scales: F64) -> bool:
    return bool(np.abs(scales / scales.mean() - 1.0).max() < _ALIKE)


def _of_equal_scale(
    channels: Sequence[int], corrections: Mapping[int, ChannelCorrection]
) -> list[tuple[int, ...]]:
    groups: list[list[int]] = []
    for channel in channels:
        scale = corrections[channel].scale
        for group in groups:
            if abs(corrections[group[0]].scale / scale - 1.0) < _ALIKE:
                group.append(channel)
                break
        else:
            groups.append([channel])
    return [tuple(group) for group in groups]


def _faults_of(answers: Answers, found: _Explanation) -> list[WiringFault]:
    keys = answers.space.keys
    faults = []
    structure = found.structure
    if structure.kind:
        faults.append(
            WiringFault(
                kind=structure.kind,
                channels=tuple(keys[c] for c in structure.channels),
                text=f"{structure.text}.",
                remedy=_REMEDIES[structure.kind],
            )
        )
    for kind, channels in _groups(answers, found.corrections):
        corrections = [found.corrections[c] for c in channels]
        faults.append(
            WiringFault(
                kind=kind,
                channels=tuple(keys[c] for c in channels),
                text=_told(kind, [keys[c] for c in channels], corrections),
                remedy=_REMEDIES[kind],
            )
        )
    return faults


def _told(kind: str, keys: Sequence[str], corrections: Sequence[ChannelCorrection]) -> str:
    """Describe a group of corrections as a sentence."""
    names = ", ".join(keys)
    first = corrections[0]
    if kind == "sign":
        return f"{names}: the answers have the opposite sign."
    if kind == "gripper":
        return f"{names}: the answers are 1 minus the recorded values."
    if kind == "degrees":
        wrong = "the answers are" if first.scale > 1.0 else "the recording is"
        right = "the recording" if first.scale > 1.0 else "the answers"
        return f"{names}: {wrong} in degrees, {right} in radians."
    if kind == "scale":
        mean = float(np.mean([correction.scale for correction in corrections]))
        return f"{names}: the answers are {mean:.4g} times the recorded values."
    if kind == "offset":
        return f"{names}: the answers are the recorded values {first.offset:+.4g}."
    told = ", ".join(
        f"{key} = {c.scale:.3g} * recorded {c.offset:+.3g}"
        for key, c in zip(keys, corrections, strict=True)
    )
    return f"scale and offset differ: {told}."


def _declared_rate(answers: Answers) -> list[WiringFault]:
    """Check the rate declared by a backend, if its answers cannot show another one."""
    if answers.horizon > 1 or answers.stretch == 1.0 or answers.space.kind == "ee_delta":
        return []
    return [
        WiringFault(
            kind="rate",
            channels=answers.space.keys,
            text=f"the backend says {1.0 / answers.step_s:.3g} Hz, the data set has "
            f"{answers.fps:.3g} Hz; answers of one row do not show which is right.",
            remedy=_REMEDIES["rate"],
        )
    ]


def _unexplained(
    answers: Answers, expected: F64, losses: F64, told: NDArray[np.bool_]
) -> list[WiringFault]:
    """Moving channels without any explanation, except those already reported (`told`) or
    undetermined, (C,).
    """
    size = answers.space.size
    flat = expected.reshape(-1, size)
    moves = np.nanstd(flat, axis=0) >= answers.least_spreads(flat)
    suspects = np.flatnonzero(moves & ~told & ~answers.is_gripper & (losses > _FOLLOWS))
    if not suspects.size:
        return []
    names = tuple(answers.space.keys[c] for c in suspects)
    return [
        WiringFault(
            kind="unexplained",
            channels=names,
            text=f"{', '.join(names)}: the answers do not follow the recording, and no wiring "
            "that was tried explains it.",
            remedy=_REMEDIES["unexplained"],
        )
    ]


_REMEDIES = {
    "swapped": "Compare the order of the policy's action names with the channels of the backend.",
    "degrees": "Set the unit where the backend converts the policy's joints; if the data set is "
    f"the one in degrees (a factor of {DEGREES:.1f}), say --unit deg.",
    "sign": "Check the direction of these joints or axes in the options of the backend.",
    "offset": "Check the zero positions (calibration) that policy and robot assume.",
    "scale": "Check units and normalisation of these channels.",
    "gripper": "Check which end of the gripper's range the policy and the data set call open.",
    "statistics": "Check that the normalisation statistics are those of this data set and "
    "checkpoint (dataset_stats, unnorm_key, profile).",
    "rate": "Set the rate that the policy was trained for.",
    "relative_for_absolute": "Declare that the policy's actions are relative to the state.",
    "absolute_for_relative": "Declare that the policy's actions are absolute.",
    "relative_to_start": "Declare that rows are relative to the begin of their chunk.",
    "frame": "Check the frame in which the policy was trained: base or TCP, and its axes.",
    "shifted": "Check how observations and actions were paired in training (delta indices), and "
    "rows that the backend leaves out.",
    "unexplained": "Check cameras, instruction, image size and the checkpoint; and that the policy "
    "was trained on such data.",
}
