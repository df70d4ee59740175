"""The contract of monitors, and the cases of those shipped here; loaded by the contract kit and by tests only.

A third party tries a monitor of its own with a `MonitorCase` and `RULES`, as this package's tests do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from rn_tasks.hooks import MonitorSpec
from rn_tasks.monitor import Monitor, Score
from rn_tasks.plugin import MONITORS
from rn_testing.case import Case
from rn_testing.rule import NotApplicable, Rule, require
from rn_testing.rules import rules_of
from roboneuron import CameraCalibration, Frame, Observation, Pose

F64 = NDArray[np.float64]
_SURE = 0.9
"""The default of `at_least`: from here on a predicate takes a score as true."""
_SIDE_PX = 224
_PAINT = {"red": (200, 25, 25), "blue": (25, 60, 210)}
_OBJECT_M = 0.025
_TCP = Pose(position_m=np.array([0.45, 0.0, 0.25]), quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0]))


@dataclass(frozen=True, kw_only=True)
class MonitorCase(Case[MonitorSpec]):
    """A monitor to try.

    Attributes:
        before: how things are when an attempt begins; None when the case has nothing to show.
        achieved: what it detects has come about.
        missed: it has not.
    """

    subject: ClassVar[str] = "monitor"

    before: Observation | None = None
    achieved: Observation | None = None
    missed: Observation | None = None

    def build(self) -> Monitor:
        """A new monitor."""
        return cast("Monitor", self.prepare()())

    def scores(self, monitor: Monitor | None = None) -> tuple[Score, Score]:
        """Of `achieved` and of `missed`, after `before`. Raises NotApplicable when the case has none of these."""
        if self.before is None or self.achieved is None or self.missed is None:
            raise NotApplicable("the case shows no observations")
        monitor = monitor or self.build()
        monitor.reset(self.before)
        achieved = monitor.score(self.achieved)
        monitor.reset(self.before)
        return achieved, monitor.score(self.missed)


def _check_achieved(case: MonitorCase) -> None:
    score = case.scores()[0]
    require(score.value is not None and score.value >= _SURE, f"scored {score.value} ({score.reason}), expected 0.9")


def _check_missed(case: MonitorCase) -> None:
    score = case.scores()[1]
    require(score.value is not None, f"what has not come about cannot be judged: {score.reason}")
    require((score.value or 0.0) < _SURE / 2, f"scored {score.value} ({score.reason}), expected well below 0.9")


def _check_blind(case: MonitorCase) -> None:
    case.scores()
    assert case.before is not None
    monitor = case.build()
    monitor.reset(case.before)
    score = monitor.score(replace(case.before, frames={}))
    require(score.value is None, f"scored {score.value} without any image, expected None")


def _check_never_reset(case: MonitorCase) -> None:
    case.scores()
    assert case.before is not None
    monitor = case.build()
    monitor.reset(replace(case.before, frames={}))
    monitor.score(replace(case.before, frames={}))


def _check_form(case: MonitorCase) -> None:
    for score in case.scores():
        require(isinstance(score, Score), f"returned {score!r}, expected a Score")
        require(score.value is None or 0.0 <= score.value <= 1.0, f"scored {score.value}, expected 0 .. 1 or None")
        require(bool(score.reason) and not score.reason.endswith("."), f"the reason is {score.reason!r}")


def _check_repeatable(case: MonitorCase) -> None:
    first, again = case.scores(), case.scores()
    require(first == again, f"the same observations gave {first} and {again}")


def _check_reset(case: MonitorCase) -> None:
    monitor = case.build()
    first, again = case.scores(monitor), case.scores(monitor)
    require(first == again, f"after another reset it gave {again}, before {first}")


_OWN: tuple[Rule[MonitorCase], ...] = tuple(
    Rule(id=f"monitor/{name}", text=text, source="rn_tasks.monitor.Monitor", check=check)
    for name, text, check in (
        ("achieved-scores-high", "What has come about scores 0.9 or more.", _check_achieved),
        ("missed-scores-low", "What has not come about is judged, and scores less than 0.45.", _check_missed),
        ("blind-is-not-judged", "Without any image the score is None, not a guess.", _check_blind),
        ("blind-start-is-no-error", "A task may begin without images.", _check_never_reset),
        ("score-has-its-form", "Scores are 0 .. 1 or None, each with a reason without full stop.", _check_form),
        ("repeatable", "The same observations give the same scores.", _check_repeatable),
        ("reset-forgets", "After `reset` with the same observation it judges as before.", _check_reset),
    )
)
RULES: tuple[Rule[MonitorCase], ...] = (*cast("tuple[Rule[MonitorCase], ...]", rules_of("monitor")), *_OWN)
"""Rules of a monitor: those of every descriptor, and its own."""


def calibration(eye_m: F64, target_m: F64, mount: str) -> CameraCalibration:
    """A pinhole camera at `eye_m` that looks at `target_m`, in the mount frame."""
    z = (target_m - eye_m) / np.linalg.norm(target_m - eye_m)
    x = np.cross(z, [0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.column_stack([x, np.cross(z, x), z]), eye_m
    intrinsics = np.array([[220.0, 0.0, _SIDE_PX / 2], [0.0, 220.0, _SIDE_PX / 2], [0.0, 0.0, 1.0]])
    return CameraCalibration(intrinsics=intrinsics, mount=mount, T_mount_camera=pose)


FRONT = calibration(np.array([1.2, 0.4, 0.8]), np.array([0.45, 0.0, 0.1]), "base")
SIDE = calibration(np.array([0.4, -0.9, 0.6]), np.array([0.45, 0.0, 0.1]), "base")


def observe(objects: Mapping[str, tuple[float, float, float]], *, tcp: Pose = _TCP, stamp_ns: int = 1) -> Observation:
    """Two calibrated cameras beside a grey table with balls: colour -> place in the base frame [m]."""
    frames = {
        role: Frame(camera=role, image=_painted(camera, objects), stamp_ns=stamp_ns, frame_id=role, calibration=camera)
        for role, camera in (("primary", FRONT), ("wrist", SIDE))
    }
    return Observation(frames=frames, instruction="try", ee_pose=tcp, gripper_open=0.5, stamp_ns=stamp_ns)


def _painted(camera: CameraCalibration, objects: Mapping[str, tuple[float, float, float]]) -> NDArray[np.uint8]:
    image = np.full((_SIDE_PX, _SIDE_PX, 3), 180, dtype=np.uint8)
    rows, columns = np.mgrid[:_SIDE_PX, :_SIDE_PX] + 0.5
    base = np.linalg.inv(camera.T_mount_camera)
    for colour, place in objects.items():
        seen = base[:3, :3] @ np.array(place) + base[:3, 3]
        pixel = camera.intrinsics @ (seen / seen[2])
        radius = camera.intrinsics[0, 0] * _OBJECT_M / seen[2]
        image[np.hypot(columns - pixel[0], rows - pixel[1]) <= radius] = _PAINT[colour]
    return image


def _case(name: str, before: Observation, achieved: Observation, missed: Observation) -> MonitorCase:
    spec = next(spec for spec in MONITORS if spec.name == name)
    return MonitorCase(spec=spec, before=before, achieved=achieved, missed=missed)


_LIES = {"red": (0.5, 0.1, 0.02), "blue": (0.4, -0.1, 0.02)}


def lifted_case() -> MonitorCase:
    """A red ball that is lifted by 15 cm; and one that is pushed aside."""
    return _case(
        "colour-lifted",
        before=observe(_LIES),
        achieved=observe({**_LIES, "red": (0.5, 0.1, 0.17)}),
        missed=observe({**_LIES, "red": (0.55, 0.0, 0.02)}),
    )


def region_case() -> MonitorCase:
    """A red ball inside and outside of the default region."""
    return _case(
        "object-in-region",
        before=observe(_LIES),
        achieved=observe(_LIES),
        missed=observe({**_LIES, "red": (0.5, 0.1, 0.2)}),
    )


def changed_case() -> MonitorCase:
    """A ball is gone; nothing has changed."""
    return _case(
        "scene-changed", before=observe(_LIES), achieved=observe({"blue": (0.4, 0.1, 0.02)}), missed=observe(_LIES)
    )


CASES: tuple[Callable[[], MonitorCase], ...] = (lifted_case, region_case, changed_case)
"""Cases of the shipped monitors."""
