"""Limits tightened by a client: their values, their combination with the configured ones, and their
file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from roboneuron import foreign
from roboneuron.config import models
from roboneuron.contract import RobotProfile
from roboneuron.errors import ConfigurationError, ForeignDataError, InvalidInputError, RefusedError
from roboneuron.gate.motion.rules import FAR_M, beyond, motion_rules

FILE_NAME = "limits.tightened.json"
_MOST_ZONES = 16
_AXES = ("x", "y", "z")
_BOXES = ("keep_out", "arm_keep_out")
"""Fields of boxes, for the TCP and for the whole arm."""
Metres = Annotated[float, Field(ge=-FAR_M, le=FAR_M)]
Corner = Annotated[list[Metres], Field(min_length=3, max_length=3)]


class WorkspaceBox(BaseModel):
    """A box in the base frame."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    lower_m: Corner
    upper_m: Corner


class Tightening(BaseModel):
    """Limits tighter than configured; None for unchanged ones."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    max_speed_m_s: Annotated[float, Field(gt=0, le=3)] | None = None
    acceleration: Annotated[float, Field(gt=0, le=1)] | None = None
    x_min_m: Metres | None = None
    x_max_m: Metres | None = None
    y_min_m: Metres | None = None
    y_max_m: Metres | None = None
    z_min_m: Metres | None = None
    z_max_m: Metres | None = None
    keep_out: tuple[WorkspaceBox, ...] = ()
    arm_keep_out: tuple[WorkspaceBox, ...] = ()

    def tighter(self, more: Tightening) -> Tightening:
        """Combine two sets: the tighter value of each.

        Raises:
            InvalidInputError: there are too many boxes.
        """
        made: dict[str, object] = {}
        for name in _BOXES:
            every = (*getattr(self, name), *getattr(more, name))
            boxes = tuple(dict.fromkeys(map(_frozen, every)))
            if len(boxes) > _MOST_ZONES:
                raise InvalidInputError(
                    f"There would be {len(boxes)} boxes to keep out of, at most {_MOST_ZONES} are "
                    "kept."
                )
            made[name] = [{"lower_m": lower, "upper_m": upper} for lower, upper in boxes]
        for name in type(self).model_fields:
            if name not in _BOXES:
                values = [v for v in (getattr(self, name), getattr(more, name)) if v is not None]
                made[name] = (max if name.endswith("_min_m") else min)(values, default=None)
        return Tightening.model_validate(made)

    def applied(
        self, configured: models.LimitsConfig, profile: RobotProfile
    ) -> models.LimitsConfig:
        """Apply these to the configured limits; never wider than either, or than the robot's
        workspace.

        Raises:
            InvalidInputError: nothing would be left of the workspace, or a box is invalid.
        """
        lower, upper = _workspace(configured, profile)
        for index, axis in enumerate(_AXES):
            low, high = getattr(self, f"{axis}_min_m"), getattr(self, f"{axis}_max_m")
            lower[index] = max(lower[index], -FAR_M if low is None else low)
            upper[index] = min(upper[index], FAR_M if high is None else high)
        boxes: list[dict[str, object]] = [
            {"name": f"kept out {number}", "lower_m": box.lower_m, "upper_m": box.upper_m}
            for number, box in enumerate(self.keep_out, 1)
        ]
        boxes += [
            {
                "name": _face_of(box) or f"kept out {number} by the arm",
                "lower_m": box.lower_m,
                "upper_m": box.upper_m,
                "applies_to": "arm",
            }
            for number, box in enumerate(self.arm_keep_out, 1)
        ]
        zones = models.LimitsConfig.model_validate({"zones": boxes}).zones
        changes: dict[str, object] = {
            "workspace_lower_m": lower,
            "workspace_upper_m": upper,
            "zones": (*configured.zones, *zones),
            "max_speed_m_s": min(configured.max_speed_m_s, self.max_speed_m_s or np.inf),
            "acceleration_fraction": min(
                configured.acceleration_fraction, self.acceleration or 1.0
            ),
        }
        made = configured.model_copy(update=changes)
        try:
            motion_rules(made, profile)
        except ConfigurationError as error:
            raise InvalidInputError(f"These limits leave nothing: {error.message}") from error
        return made

    @property
    def is_empty(self) -> bool:
        """True if nothing is tightened."""
        return self == Tightening()


@dataclass(frozen=True, kw_only=True, slots=True)
class TightenedRecord:
    """Content of the file: the limits, their author and time."""

    tightening: Tightening
    who: str
    at_ns: int


class TighteningFile:
    """Stores the limits in the state directory, so that a restart of a module or server does not
    loosen them.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> TightenedRecord | None:
        """Read the stored limits; None without a file.

        Raises:
            ConfigurationError: it cannot be read; names a remedy.
        """
        try:
            told = foreign.read_json(self.path)
            return TightenedRecord(
                tightening=foreign.to_model(
                    Tightening, foreign.field(told, "tightened"), FILE_NAME
                ),
                who=foreign.text(foreign.field(told, "who"), "who", 200),
                at_ns=foreign.integer(foreign.field(told, "at_ns"), "at_ns"),
            )
        except FileNotFoundError:
            return None
        except ForeignDataError as error:
            raise ConfigurationError(
                f"The tightened limits in {self.path} cannot be read: {error}.",
                hint="A person writes them anew: roboneuron robot limits --loosen.",
            ) from error

    def write(self, record: TightenedRecord) -> None:
        """Write the file atomically.

        Raises:
            RefusedError: it cannot be written.
        """
        text = {
            "tightened": record.tightening.model_dump(),
            "who": record.who,
            "at_ns": record.at_ns,
        }
        try:
            foreign.write_private(self.path, json.dumps(text))
        except OSError as error:
            raise RefusedError(
                f"The limits cannot be kept in {self.path}: {error.strerror}.",
                hint="Mend the state directory.",
                rule="audit",
            ) from error


def _face_of(box: WorkspaceBox) -> str:
    """Name of the face beyond which a box is everything; empty for another box."""
    for axis in range(3):
        for relation, edge_m in ((">=", box.upper_m[axis]), ("<=", box.lower_m[axis])):
            whole = beyond(axis, relation, edge_m)
            if (whole.lower_m.tolist(), whole.upper_m.tolist()) == (box.lower_m, box.upper_m):
                return whole.name
    return ""


def _frozen(box: WorkspaceBox) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return tuple(box.lower_m), tuple(box.upper_m)


def _workspace(
    configured: models.LimitsConfig, profile: RobotProfile
) -> tuple[list[float], list[float]]:
    """The configured corners, or those of the robot, which hold for its TCP alone."""
    own = profile.workspace if configured.applies_to == "tcp" else None
    lower = configured.workspace_lower_m or ([-FAR_M] * 3 if own is None else own.lower_m.tolist())
    upper = configured.workspace_upper_m or ([FAR_M] * 3 if own is None else own.upper_m.tolist())
    return list(lower), list(upper)
