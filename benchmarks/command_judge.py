"""Judges the joint commands of control against the limits that it has to keep: by their positions,
durations and times alone, not by measurements, whose stamps are late by milliseconds.

A command is a straight line at constant velocity, from where the one before has come to until the
next one replaces it. Its velocity may differ from that before by no more than the acceleration
limits allow in the time since.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from roboneuron import JointLimits
from roboneuron.modules.settings import HOLD_DURATION_S

F64 = NDArray[np.float64]
HELD_S = 0.005
"""A hold is known by its message, which is so much later than its time at most."""
_SHORTEST_S = 1e-3
_MEMORY_S = 1.0
"""Control starts from the measured posture after so long without a command."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class SentCommand:
    """One command.

    Attributes:
        at_ns: its beginning [ns since 1970].
        duration_s: time to reach `target`.
        target: float64 (n,) of the arm.
        measured: float64 (n,), where the arm was; empty if that is not known.
        is_lost: control has given up the command before, as the arm did not follow it.
        is_hold: it was not computed for an action or a row: the limits do not apply.
    """

    at_ns: int
    duration_s: float
    target: F64
    measured: F64 = field(default_factory=lambda: np.zeros(0))
    is_lost: bool = False
    is_hold: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Judged:
    """What one command asks of the arm.

    Attributes:
        at_ns: its beginning.
        acceleration: change of velocity as a share of what the limits allow, of all joints the
            largest.
        step_rad_s: the same change.
        velocity: as a share of the limit.
        held_rad_s: commanded velocity that a hold has ended; 0 for other commands.
    """

    at_ns: int
    acceleration: float = 0.0
    step_rad_s: float = 0.0
    velocity: float = 0.0
    held_rad_s: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Commanded:
    """Largest values of the commands in a span; see `Judged`.

    Attributes:
        count: commands that were judged.
    """

    count: int
    acceleration: float
    step_rad_s: float
    velocity: float
    held_rad_s: float


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Line:
    """The command in progress."""

    begun: SentCommand
    start: F64

    def at(self, passed_s: float, hardest: F64) -> tuple[F64, F64]:
        """Position and velocity so long after its beginning, float64 (n,) each."""
        velocity = (self.begun.target - self.start) / self.begun.duration_s
        over_s = max(0.0, passed_s - self.begun.duration_s)
        left = np.maximum(np.abs(velocity) - hardest * over_s, 0.0)
        share = min(1.0, max(0.0, passed_s / self.begun.duration_s))
        return self.start + (self.begun.target - self.start) * share, np.copysign(left, velocity)


def noted(path: Path, since_ns: int) -> list[SentCommand]:
    """Commands that takeover_plugin.py has noted since then."""
    rows = [json.loads(line) for line in path.read_text().splitlines() if line.endswith("}")]
    return [
        SentCommand(
            at_ns=row["at_ns"],
            is_lost=row["is_lost"],
            duration_s=row["duration_s"],
            target=np.array(row["target"]),
            measured=np.array(row["measured"]),
        )
        for row in rows
        if row["at_ns"] >= since_ns
    ]


def in_order(
    notes: Sequence[SentCommand], messages: Sequence[SentCommand]
) -> tuple[list[SentCommand], int]:
    """The notes with the holds between them, which are not noted; and how many of the messages are
    neither.

    Args:
        notes: as computed, with exact times.
        messages: as received, with the time of sending.
    """
    known: dict[bytes, list[SentCommand]] = {}
    for note in notes:
        known.setdefault(note.target.tobytes(), []).append(note)
    found, unknown = list(notes), 0
    newest_ns = notes[-1].at_ns if notes else 0
    for message in messages:
        if message.at_ns > newest_ns:  # it may be of the newest command, which is no note yet
            break
        same = known.get(message.target.tobytes(), [])
        if any(note.at_ns <= message.at_ns for note in same):
            continue
        if abs(message.duration_s - HOLD_DURATION_S) < _SHORTEST_S:
            found.append(replace(message, is_hold=True))
        else:
            unknown += 1
    return sorted(found, key=lambda one: one.at_ns), unknown


def judged(commands: Sequence[SentCommand], limits: JointLimits) -> list[Judged]:
    """Judge commands in their order. Left out are those whose beginning is not known: the first,
    and those that control starts from the measured posture.

    Args:
        commands: of one control.
        limits: of the arm's joints.
    """
    found: list[Judged] = []
    line: Line | None = None
    for command in commands:
        passed_s = 0.0 if line is None else (command.at_ns - line.begun.at_ns) / 1e9
        if command.is_hold:
            if line is not None:
                _, velocity = line.at(passed_s, limits.acceleration)
                held = float(np.abs(velocity).max())
                found.append(Judged(at_ns=command.at_ns, held_rad_s=held))
            line = Line(begun=command, start=command.target)
            continue
        if line is None or passed_s >= _MEMORY_S or command.is_lost:
            line = Line(begun=command, start=command.measured)
            continue
        start, before = line.at(passed_s, limits.acceleration)
        if line.begun.is_hold:
            passed_s += HELD_S
        time_s = max(_SHORTEST_S, min(passed_s, command.duration_s))
        velocity = (command.target - start) / command.duration_s
        step = np.abs(velocity - before)
        found.append(
            Judged(
                at_ns=command.at_ns,
                acceleration=float((step / (limits.acceleration * time_s)).max()),
                step_rad_s=float(step.max()),
                velocity=float((np.abs(velocity) / limits.velocity).max()),
            )
        )
        line = Line(begun=command, start=start)
    return found


def largest(found: Sequence[Judged], begin_ns: int, end_ns: int) -> Commanded | None:
    """Largest values within a span; None without commands."""
    rows = [row for row in found if begin_ns <= row.at_ns <= end_ns]
    if not rows:
        return None
    return Commanded(
        count=len(rows),
        acceleration=max(row.acceleration for row in rows),
        step_rad_s=max(row.step_rad_s for row in rows),
        velocity=max(row.velocity for row in rows),
        held_rad_s=max(row.held_rad_s for row in rows),
    )
