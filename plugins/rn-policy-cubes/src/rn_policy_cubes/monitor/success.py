"""The monitor `cubes-success`: progress, success and failure of "pick up the red cube"."""

from __future__ import annotations

import math
import re
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from rn_policy_cubes.monitor.layers import state_of
from rn_policy_cubes.monitor.views import close_view, whole_view
from rn_policy_cubes.monitor.weights import MonitorWeights, shipped_monitor
from rn_simulation.cubes import DEFAULT_COLOURS
from rn_standard.tasks.monitor import Score
from rn_standard.tasks.pictures import FrozenPictures
from roboneuron import ConfigurationOnly, Observation

COLOURS = DEFAULT_COLOURS
HELD_S = 1.0
"""Time for which every picture has to show the cube in the raised hand [s]."""
COUNTS = 0.9
"""Probability at the calibrated threshold, the default of `at_least`."""
_FAILED_S = 0.55
"""The same for a failed attempt."""
_ROUNDING_S = 1e-3
_GAP_S = 1.0
"""Longest time between two pictures of one history; after a longer one nothing is known."""
_LOW_M = 0.12
"""Height below which the hand can have reached for a cube."""
_WAS_UP, _IS_DOWN = 0.85, 0.62
"""Progress of a cube 6 cm up, and of one on the table."""
_MISSING, _OTHER, _DROPPED = "missing", "other", "dropped"


class SuccessOptions(BaseModel):
    """Options of `cubes-success`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    colour: Literal["", "red", "green", "blue", "yellow"] = Field(
        default="", description="of the cube to be lifted; as the instruction says when empty"
    )
    weights: Annotated[str, ConfigurationOnly()] = Field(
        default="", description="file of `policy cubes monitor train`; the shipped one when empty"
    )


@dataclass(frozen=True, slots=True)
class _Told:
    """What the network says of one picture."""

    stamp_s: float
    lifted: NDArray[np.float64]
    progress: NDArray[np.float64]
    missing: NDArray[np.float64]


class CubesSuccess:
    """Follows `rn_standard.tasks.monitor.Monitor`; NumPy only.

    It needs the calibrated fixed camera of role "primary", the TCP and the opening. Success is the
    lowest probability within the last second, recalibrated so that 0.9 is the threshold chosen on
    the calibration set; a frozen camera gives None.

    Attributes:
        raw: probabilities of success and of failure before the recalibration.
    """

    def __init__(self, config: SuccessOptions | None) -> None:
        self._options = config or SuccessOptions()
        self._weights: MonitorWeights | None = None
        self._begin()

    @classmethod
    def of(cls, weights: MonitorWeights, config: SuccessOptions | None = None) -> CubesSuccess:
        """The monitor with other weights than the shipped ones."""
        made = cls(config)
        made._weights = weights
        return made

    def _file(self) -> Path:
        return Path(self._options.weights) if self._options.weights else shipped_monitor()

    def _begin(self) -> None:
        self._history: deque[_Told] = deque()
        self._pictures = FrozenPictures()
        self._was_low = False
        self._best = np.zeros(len(COLOURS))
        self.raw = (0.0, 0.0)

    def reset(self, observation: Observation) -> None:
        """See `Monitor`."""
        if self._weights is None:
            self._weights = MonitorWeights.read(self._file())
        self._begin()

    def score(self, observation: Observation) -> Score:
        """See `Monitor`."""
        self.raw = (0.0, 0.0)
        colour = self._options.colour or named_colour(observation.instruction)
        if not colour:
            return Score(value=None, reason="the instruction names no single cube that it knows")
        frame, pose = observation.frames.get("primary"), observation.ee_pose
        if frame is None or pose is None or observation.gripper_open is None:
            return Score(value=None, reason="it needs the fixed camera, the TCP and the gripper")
        if frame.calibration is None or frame.calibration.mount != "base":
            return Score(value=None, reason="the camera is not calibrated, or not fixed")
        now_s = max(frame.stamp_ns, pose.stamp_ns) / 1e9
        if frozen := self._pictures.look(observation, now_s):
            self._history.clear()
            return Score(value=None, reason=frozen)
        self._add(observation)
        return self._judge(COLOURS.index(colour))

    def _add(self, observation: Observation) -> None:
        frame, pose = observation.frames["primary"], observation.ee_pose
        assert self._weights is not None, "reset comes first"
        assert frame.calibration is not None
        assert pose is not None
        stamp_s = frame.stamp_ns / 1e9
        if self._history:
            gap_s = stamp_s - self._history[-1].stamp_s
            if gap_s == 0.0:
                return
            if not 0.0 < gap_s <= _GAP_S:
                self._history.clear()
        opening = np.array([observation.gripper_open])
        told = self._weights.layers(
            close_view(frame.image, frame.calibration, pose.position_m)[None],
            whole_view(frame.image)[None],
            state_of(pose.position_m[None], opening),
        )[0].astype(np.float64)
        lifted, missing = _sigmoid(told[0]), _sigmoid(told[2])
        self._history.append(_Told(stamp_s, lifted, told[1], missing))
        while len(self._history) > 2 and self._history[1].stamp_s <= stamp_s - HELD_S + _ROUNDING_S:
            self._history.popleft()
        self._was_low |= bool(pose.position_m[2] < _LOW_M)
        self._best = np.maximum(self._best, told[1])

    def _judge(self, cube: int) -> Score:
        assert self._weights is not None
        card, newest = self._weights.card, self._history[-1]
        span_s = newest.stamp_s - self._history[0].stamp_s
        held = min(float(told.lifted[cube]) for told in self._history)
        share = min(1.0, span_s / HELD_S)
        # less than a second of pictures is no success, however sure each of them is
        success = (
            held
            if span_s >= HELD_S - _ROUNDING_S
            else min(held, 0.5 * card.success_threshold) * share
        )
        failure, why = self._failure(cube)
        self.raw = (success, failure)
        value = recalibrated(success, card.success_threshold)
        return Score(
            value=value,
            reason=_reason(
                COLOURS[cube], value, why if failure >= card.failure_threshold else "", span_s
            ),
            progress=float(np.clip(newest.progress[cube], 0.0, 1.0)),
            failure=recalibrated(failure, card.failure_threshold),
        )

    def _failure(self, cube: int) -> tuple[float, str]:
        """Probability that the attempt has failed, and how."""
        since_s = self._history[-1].stamp_s - _FAILED_S
        recent = [told for told in self._history if told.stamp_s >= since_s - _ROUNDING_S]
        is_short = self._history[-1].stamp_s - self._history[0].stamp_s < _FAILED_S - _ROUNDING_S
        if is_short or not self._was_low:
            return 0.0, ""
        others = [index for index in range(len(COLOURS)) if index != cube]
        found = {
            _MISSING: min(float(told.missing[cube]) for told in recent),
            _OTHER: min(
                float(told.lifted[others].max() * (1.0 - told.lifted[cube])) for told in recent
            ),
        }
        if self._best[cube] >= _WAS_UP:
            lowest = max(float(told.progress[cube]) for told in recent)
            found[_DROPPED] = 0.99 if lowest <= _IS_DOWN else 0.0
        why = max(found, key=lambda name: found[name])
        return found[why], why


def named_colour(instruction: str) -> str:
    """The one colour of a known cube that an instruction names; empty for none or several, and for
    other colours beside it.
    """
    words = set(re.findall(r"[a-z]+", instruction.lower()))
    named = words & {*COLOURS, "orange", "purple"}
    return next(iter(named)) if len(named) == 1 and named <= set(COLOURS) else ""


def recalibrated(probability: float, threshold: float) -> float:
    """Shift a probability on the log-odds scale so that the threshold becomes `COUNTS`."""
    shifted = _logit(probability) - _logit(threshold) + _logit(COUNTS)
    return 1.0 / (1.0 + math.exp(-shifted))


def _logit(probability: float) -> float:
    kept = min(max(probability, 1e-6), 1.0 - 1e-6)
    return math.log(kept / (1.0 - kept))


def _sigmoid(value: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(value, -30.0, 30.0))))


def _reason(colour: str, value: float, failed: str, span_s: float) -> str:
    if value >= COUNTS:
        return f"the {colour} cube is held up in the hand"
    texts = {
        _MISSING: f"the closed hand is up without the {colour} cube",
        _OTHER: f"another cube than the {colour} one is up",
        _DROPPED: f"the {colour} cube was up and is not any more",
    }
    if failed:
        return texts[failed]
    if span_s < HELD_S - _ROUNDING_S:
        return f"it has watched for {span_s:.1f} s only"
    return f"the {colour} cube is not held up"
