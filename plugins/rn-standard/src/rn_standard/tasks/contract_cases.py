"""Contract of monitors, and the cases of those in this package; loaded only by the contract kit and
by tests.

Third parties test their monitors with `contract_of(MonitorSpec)` and a `MonitorCase`, as this
package's tests do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from rn_standard.tasks.hooks import MonitorSpec
from rn_standard.tasks.monitor import Monitor, Score
from rn_standard.tasks.plugin import MONITORS
from rn_testing.case import Case
from rn_testing.effects import check_quick
from rn_testing.kinds import Kind
from rn_testing.lifecycle import ALONE, PURE, check_pure_constructor
from rn_testing.options import OPTIONS_READ, check_options_read
from rn_testing.process_state import find_changes
from rn_testing.rule import NotApplicable, Rule, require
from rn_testing.rules import OF_EVERY_DESCRIPTOR
from rn_testing.snapshots import snapshot
from roboneuron import F64, CameraCalibration, Frame, Observation, Pose

_SURE = 0.9
"""Default of `at_least`: the score from which a predicate is true."""
SCORE_LIMIT_S = 0.05
"""Bound on the fastest of several scores, as specified in `Monitor.score`: a busy machine slows
down some, not all.
"""
LONGEST_REASON = 300
"""Maximum length of a reason [characters], which agents read with every answer."""
_SIDE_PX = 224
_PAINT = {"red": (200, 25, 25), "blue": (25, 60, 210)}
_OBJECT_M = 0.025
_TCP = Pose(position_m=np.array([0.45, 0.0, 0.25]), quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0]))


@dataclass(frozen=True, kw_only=True)
class MonitorCase(Case[MonitorSpec]):
    """A monitor to be tested.

    Attributes:
        before: observation at the start of an attempt; two balls on a table if None.
        achieved: observation in which its condition is true, or several in the order of time, of
            which the last counts.
        missed: the same for one in which it is false.
    """

    subject: ClassVar[str] = "monitor"

    before: Observation | None = None
    achieved: Observation | tuple[Observation, ...] | None = None
    missed: Observation | tuple[Observation, ...] | None = None

    def build(self) -> Monitor:
        """Create a new monitor."""
        return cast("Monitor", self.prepare()())

    def start(self) -> Observation:
        """Observation at the start of an attempt."""
        return observe(_LIES) if self.before is None else self.before

    def scores(self, monitor: Monitor | None = None) -> tuple[Score, Score]:
        """Scores of `achieved` and of `missed`, after `before`. Raises NotApplicable if the case
        lacks them.
        """
        if self.achieved is None or self.missed is None:
            raise NotApplicable("the case shows no observations")
        monitor = monitor or self.build()
        monitor.reset(self.start())
        achieved = last_score(monitor, self.achieved)
        monitor.reset(self.start())
        return achieved, last_score(monitor, self.missed)


def last_score(monitor: Monitor, seen: Observation | tuple[Observation, ...]) -> Score:
    """The score of the last of some observations, after those before."""
    scores = [monitor.score(each) for each in ((seen,) if isinstance(seen, Observation) else seen)]
    return scores[-1]


def _check_achieved(case: MonitorCase) -> None:
    score = case.scores()[0]
    require(
        score.value is not None and score.value >= _SURE,
        f"scored {score.value} ({score.reason}), expected 0.9",
    )


def _check_missed(case: MonitorCase) -> None:
    score = case.scores()[1]
    require(score.value is not None, f"what has not come about cannot be judged: {score.reason}")
    require(
        (score.value or 0.0) < _SURE / 2,
        f"scored {score.value} ({score.reason}), expected well below 0.9",
    )


def _check_undone(case: MonitorCase) -> None:
    case.scores()
    assert case.achieved is not None
    assert case.missed is not None
    monitor = case.build()
    monitor.reset(case.start())
    last_score(monitor, case.achieved)
    score = last_score(monitor, case.missed)
    undone = score.value is None or score.value < _SURE
    require(undone, f"what had come about and is undone scores {score.value} ({score.reason})")


def _blind(observation: Observation) -> Observation:
    return replace(observation, frames={})


def _check_blind(case: MonitorCase) -> None:
    monitor = case.build()
    monitor.reset(case.start())
    score = monitor.score(_blind(case.start()))
    require(score.value is None, f"scored {score.value} without any image, expected None")


def _check_never_reset(case: MonitorCase) -> None:
    monitor = case.build()
    monitor.reset(_blind(case.start()))
    monitor.score(_blind(case.start()))


def _all_scores(case: MonitorCase) -> list[Score]:
    """Scores of all observations of the case, and of its start without images."""
    monitor = case.build()
    found = []
    for seen in (case.start(), case.achieved, case.missed, _blind(case.start())):
        if seen is not None:
            monitor.reset(case.start())
            found.append(last_score(monitor, seen))
    return found


def _check_form(case: MonitorCase) -> None:
    for score in _all_scores(case):
        require(isinstance(score, Score), f"returned {score!r}, expected a Score")
        for name in ("value", "progress", "failure"):
            told = getattr(score, name)
            require(
                told is None or 0.0 <= told <= 1.0,
                f"its {name} is {told}, expected 0 .. 1 or None",
            )
        reason = score.reason
        require(bool(reason) and not reason.endswith("."), f"the reason is {reason!r}")
        is_short = len(reason) <= LONGEST_REASON and "\n" not in reason
        require(
            is_short,
            f"the reason has {len(reason)} characters: {reason[:60]!r}; expected a short sentence",
        )


def _check_repeatable(case: MonitorCase) -> None:
    first, again = _all_scores(case), _all_scores(case)
    require(first == again, f"the same observations gave {first} and {again}")


def _check_reset(case: MonitorCase) -> None:
    monitor = case.build()
    first, again = case.scores(monitor), case.scores(monitor)
    require(first == again, f"after another reset it gave {again}, before {first}")


def _check_input_kept(case: MonitorCase) -> None:
    start = case.start()
    before = snapshot(start)
    monitor = case.build()
    monitor.reset(start)
    monitor.score(start)
    require(snapshot(start) == before, "it wrote into its observation")


def _check_quick(case: MonitorCase) -> None:
    monitor, start = case.build(), case.start()
    monitor.reset(start)
    limit_s = max(case.spec.limit_s, SCORE_LIMIT_S)
    check_quick(limit_s, lambda: monitor.score(start), "score", tries=7)


def _check_process(case: MonitorCase) -> None:
    changes = find_changes(lambda: _all_scores(case))
    require(not changes, f"it {'; '.join(changes)}")


def _check_options(case: MonitorCase) -> None:
    def use(build: Callable[[], Monitor]) -> None:
        monitor = build()
        for seen in (case.start(), case.achieved, case.missed):
            if seen is not None:
                monitor.reset(case.start())
                last_score(monitor, seen)

    check_options_read(case, use)


def _check_methods(case: MonitorCase) -> None:
    made = case.build()
    missing = [name for name in ("reset", "score") if not callable(getattr(made, name, None))]
    require(not missing, f"{type(made).__name__} lacks {', '.join(missing)}")


_OWN: tuple[Rule[MonitorCase], ...] = tuple(
    Rule(id=f"monitor/{name}", text=text, source="rn_standard.tasks.monitor.Monitor", check=check)
    for name, text, check in (
        ("protocol", "It has the methods of Monitor.", _check_methods),
        ("constructor-pure", PURE, check_pure_constructor),
        ("options-read", OPTIONS_READ, _check_options),
        ("process-left-alone", ALONE, _check_process),
        ("input-kept", "It writes into no part of an observation.", _check_input_kept),
        (
            "score-quick",
            "One observation is judged within `limit_s`, 50 ms by default.",
            _check_quick,
        ),
        (
            "undone-is-not-achieved",
            "What had come about and is undone does not score 0.9.",
            _check_undone,
        ),
        ("achieved-scores-high", "What has come about scores 0.9 or more.", _check_achieved),
        (
            "missed-scores-low",
            "What has not come about is judged, and scores less than 0.45.",
            _check_missed,
        ),
        ("blind-is-not-judged", "Without any image the score is None, not a guess.", _check_blind),
        ("blind-start-is-no-error", "A task may begin without images.", _check_never_reset),
        (
            "score-has-its-form",
            "Its numbers are 0 .. 1 or None, each with a short reason without full stop.",
            _check_form,
        ),
        ("repeatable", "The same observations give the same scores.", _check_repeatable),
        (
            "reset-forgets",
            "After `reset` with the same observation it judges as before.",
            _check_reset,
        ),
    )
)
RULES: tuple[Rule[MonitorCase], ...] = (
    *cast("tuple[Rule[MonitorCase], ...]", OF_EVERY_DESCRIPTOR),
    *_OWN,
)
"""Rules of a monitor: those of every descriptor, and its own."""
KIND = Kind(case=MonitorCase, rules=RULES)
"""Parts that the kit needs to test monitors."""


def calibration(eye_m: F64, target_m: F64, mount: str) -> CameraCalibration:
    """Calibration of a pinhole camera at `eye_m` that looks at `target_m`, in the mount frame."""
    z = (target_m - eye_m) / np.linalg.norm(target_m - eye_m)
    x = np.cross(z, [0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.column_stack([x, np.cross(z, x), z]), eye_m
    intrinsics = np.array([[220.0, 0.0, _SIDE_PX / 2], [0.0, 220.0, _SIDE_PX / 2], [0.0, 0.0, 1.0]])
    return CameraCalibration(intrinsics=intrinsics, mount=mount, T_mount_camera=pose)


FRONT = calibration(np.array([1.2, 0.4, 0.8]), np.array([0.45, 0.0, 0.1]), "base")
SIDE = calibration(np.array([0.4, -0.9, 0.6]), np.array([0.45, 0.0, 0.1]), "base")


def observe(
    objects: Mapping[str, tuple[float, float, float]], *, tcp: Pose = _TCP, stamp_ns: int = 1
) -> Observation:
    """Observation by two calibrated cameras of a grey table with balls: colour -> place in the base
    frame [m].
    """
    frames = {
        role: Frame(
            camera=role,
            image=_painted(camera, objects),
            stamp_ns=stamp_ns,
            frame_id=role,
            calibration=camera,
        )
        for role, camera in (("primary", FRONT), ("wrist", SIDE))
    }
    return Observation(
        frames=frames, instruction="try", ee_pose=tcp, gripper_open=0.5, stamp_ns=stamp_ns
    )


def _painted(
    camera: CameraCalibration, objects: Mapping[str, tuple[float, float, float]]
) -> NDArray[np.uint8]:
    image = np.full((_SIDE_PX, _SIDE_PX, 3), 180, dtype=np.uint8)
    rows, columns = np.mgrid[:_SIDE_PX, :_SIDE_PX] + 0.5
    base = np.linalg.inv(camera.T_mount_camera)
    for colour, place in objects.items():
        seen = base[:3, :3] @ np.array(place) + base[:3, 3]
        pixel = camera.intrinsics @ (seen / seen[2])
        radius = camera.intrinsics[0, 0] * _OBJECT_M / seen[2]
        image[np.hypot(columns - pixel[0], rows - pixel[1]) <= radius] = _PAINT[colour]
    return image


def _case(
    name: str, before: Observation, achieved: Observation, missed: Observation
) -> MonitorCase:
    spec = next(spec for spec in MONITORS if spec.name == name)
    return MonitorCase(spec=spec, before=before, achieved=achieved, missed=missed)


_LIES = {"red": (0.5, 0.1, 0.02), "blue": (0.4, -0.1, 0.02)}


def lifted_case() -> MonitorCase:
    """A red ball that is lifted by 15 cm, and one that is pushed aside."""
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


def on_case() -> MonitorCase:
    """A red ball on the blue one, and beside it."""
    return _case(
        "object-on",
        before=observe(_LIES),
        achieved=observe({"red": (0.4, 0.1, 0.065), "blue": (0.4, 0.1, 0.02)}),
        missed=observe(_LIES),
    )


def changed_case() -> MonitorCase:
    """A removed ball, and an unchanged scene."""
    return _case(
        "scene-changed",
        before=observe(_LIES),
        achieved=observe({"blue": (0.4, 0.1, 0.02)}),
        missed=observe(_LIES),
    )


def http_case() -> MonitorCase:
    """An endpoint that nobody serves: it cannot judge, which is no error."""
    spec = next(spec for spec in MONITORS if spec.name == "http-judge")
    options = {"url": "http://127.0.0.1:9/", "timeout_s": 1.0, "side_px": 64}
    return MonitorCase(spec=spec, options=options)


CASES: tuple[Callable[[], MonitorCase], ...] = (
    lifted_case,
    region_case,
    on_case,
    changed_case,
    http_case,
)
"""Cases of this package's monitors."""
