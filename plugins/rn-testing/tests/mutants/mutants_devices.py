"""Drivers, sources and controllers whose numbers are each plausible, but wrong over time or
together.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
from mutants_sources import Streaming
from mutation import Mutant, counted, mutate, then
from pydantic import BaseModel, ConfigDict, Field

from rn_testing.fakes import ControlledSource, FakeDriver, GantryController
from roboneuron.contract import Hold, JointCommand
from roboneuron.errors import NotReadyError

NS = 1_000_000_000


def driver(rule, words="", **changes):
    return Mutant(rule=f"driver/{rule}", target=mutate(FakeDriver, **changes), words=words)


def velocity(change):
    """`read` with changed velocities."""

    def read(self, call):
        state = call()
        return replace(state, joints=replace(state.joints, velocity=change(state.joints.velocity)))

    return read


def position(change):
    def read(self, call):
        state = call()
        return replace(state, joints=replace(state.joints, position=change(self, state.joints)))

    return read


def delayed(age_s: float):
    """`read` that returns old measurements with the current stamp."""

    def read(self, call):
        state = call()
        self.past = getattr(self, "past", deque())
        self.past.append((time.monotonic(), state))
        while len(self.past) > 1 and self.past[1][0] < time.monotonic() - age_s:
            self.past.popleft()
        old = self.past[0][1]
        return replace(old, joints=replace(old.joints, stamp_ns=state.joints.stamp_ns))

    return read


def creeping(speed: float):
    """`hold` after which every joint moves home at that speed."""

    def hold(self, call):
        call()
        home = dict(zip(self._profile.arm_joints, self._profile.home_rad.tolist(), strict=True))
        goal = {**self._start, **home}
        way = max(abs(goal[name] - position) for name, position in self._start.items())
        self._move(self._start, goal, max(way / speed, 1e-3))

    return hold


def sagging(self, call):
    call()
    low = {n: p - 0.3 if n == "slide_z" else p for n, p in self._start.items()}
    self._move(self._start, low, 0.3 / 0.004)


def goes_home(self, call):
    call()
    away = {n: p + 0.1 for n, p in self._start.items() if n != "finger"} | {"finger": 0.04}
    self._move(away, self._start, 1.0)


DRIVERS = {
    "velocity_in_degrees": driver("velocity-measured", read=velocity(np.degrees)),
    "velocity_of_the_other_sign": driver("velocity-measured", read=velocity(lambda v: -v)),
    "velocity_in_millimetres": driver("velocity-measured", read=velocity(lambda v: 1000 * v)),
    "velocity_always_zero": driver(
        "velocity-measured", "add up to 0", read=velocity(lambda v: 0 * v)
    ),
    "velocity_of_another_joint": driver(
        "velocity-measured", read=velocity(lambda v: np.roll(v, 1))
    ),
    "velocity_is_the_position": driver(
        "velocity-measured",
        read=lambda s, c: (
            lambda x: replace(x, joints=replace(x.joints, velocity=-5 - x.joints.position))
        )(c()),
    ),
    "state_half_a_second_old": driver("state-fresh", "late", read=delayed(0.5)),
    "state_of_a_second_ago": driver("state-fresh", read=delayed(1.0)),
    "hold_creeps_home": driver("hold-stops", hold=creeping(0.01)),
    "hold_creeps_home_slowly": driver("hold-stops", "creeps", hold=creeping(0.004)),
    "hold_sags": driver("hold-stops", hold=sagging),
    "hold_shuts_the_gripper": driver(
        "hold-stops",
        "gripper",
        hold=lambda s, call: then(call(), s._move(s._start, {**s._start, "finger": 0.0}, 0.5)),
    ),
    "open_goes_home": driver("open-stands-still", "without any command", open=goes_home),
}


def source(rule, words="", *, base=ControlledSource, case=None, spec=None, **changes):
    target = mutate(base, **changes)
    return Mutant(
        rule=f"perception/{rule}", target=target, case=case or {}, spec=spec or {}, words=words
    )


class Pace(BaseModel):
    """Options of a camera stream."""

    model_config = ConfigDict(extra="forbid")

    rate_hz: float = Field(default=30.0, description="frames per second")


class Stream(Streaming):
    """A good source of 30 frames a second."""

    period_s = 1 / 30

    def __init__(self, config, topics, cameras):
        super().__init__(None, topics, cameras)
        self._camera = next(iter(self._cameras), "")

    def read(self, timeout_s):
        if self._is_open and self._camera:
            due_s = getattr(self, "due_s", time.monotonic())
            if due_s - time.monotonic() > timeout_s:
                time.sleep(timeout_s)
                raise NotReadyError("No frame came.")
            time.sleep(max(0.0, due_s - time.monotonic()))
            self.due_s = max(due_s, time.monotonic() - self.period_s) + self.period_s
            self.show(self._camera)
        return ControlledSource.read(self, timeout_s)


def now_and_then_back(every: int, by_ns: int):
    def read(self, call, timeout_s):
        frame = call(timeout_s)
        return replace(
            frame, stamp_ns=frame.stamp_ns - (by_ns if counted(self) % every == 0 else 0)
        )

    return read


def kept_for_ever(self, call, timeout_s):
    """The last frame again, with a new stamp, if there is no new one."""
    try:
        self.last = call(timeout_s)
    except NotReadyError:
        if not hasattr(self, "last"):
            raise
    return replace(self.last, stamp_ns=self._topics.now_ns())


STREAM = {"feed": None, "expected": None}
PACE = {"config": "mutants_devices:Pace"}
SOURCES = {
    "calibration_dropped": source(
        "calibration-kept",
        "no calibration",
        read=lambda s, call, t: replace(call(t), calibration=None),
    ),
    "stamps_jitter": source("frames-in-order", read=now_and_then_back(9, 50_000_000)),
    "stamps_jitter_in_a_stream": source(
        "frames-in-order", base=Stream, case=STREAM, read=now_and_then_back(11, 60_000_000)
    ),
    "ten_times_too_fast": source(
        "pace-kept",
        "declared 30 Hz",
        base=Stream,
        case=STREAM,
        spec=PACE,
        read=lambda s, call, t: then(setattr(s, "period_s", 1 / 300), call(t)),
    ),
    "faster_than_its_case_says": source(
        "pace-kept", base=Stream, case={**STREAM, "rate_hz": 5.0}, read=lambda s, call, t: call(t)
    ),
    "read_waits_half_a_second": source("read-bounded", read=lambda s, call, t: call(0.4)),
    "last_frame_again": source("frame-once", "again", read=kept_for_ever),
}


def controller(rule, words="", **changes):
    return Mutant(
        rule=f"controller/{rule}", target=mutate(GantryController, **changes), words=words
    )


def to_the_limit(residual: bool):
    """`compute` that moves to the limits where the good one refuses."""

    def compute(self, call, action, joints, step_s):
        result = call(action, joints, step_s)
        if isinstance(result, JointCommand) or result.code != "joint_limit":
            return result
        limits, here = self._profile.limits, self._measured(joints)
        wanted = here + np.concatenate([action.translation_m, np.zeros(3)])
        target = np.clip(wanted, limits.lower, limits.upper)
        missed = float(np.linalg.norm((wanted - target)[:3]))
        away = not residual and missed > 0.02  # near the limit it is correct
        return JointCommand(
            names=self._profile.arm_joints,
            position=target,
            duration_s=max(step_s, float((np.abs(target - here) / limits.velocity).max())),
            residual_m=0.0 if away else missed,
        )

    return compute


def inaccurate(self, call, action, joints, step_s):
    """Ends 4 mm short of distant targets without reporting it."""
    result = call(action, joints, step_s)
    if isinstance(result, Hold) or abs(result.position[0]) < 0.6:
        return result
    return replace(
        result, position=result.position - np.array([0.004, *np.zeros(len(result.position) - 1)])
    )


CONTROLLERS = {
    "unreachable_not_refused": controller("reach-kept", "not refused", compute=to_the_limit(True)),
    "residual_always_zero": controller("reach-kept", compute=to_the_limit(False)),
    "inaccurate_far_from_home": controller("reach-kept", "says", compute=inaccurate),
}

MUTANTS: dict[str, Mutant] = {
    **{f"driver_{name}": mutant for name, mutant in DRIVERS.items()},
    **{f"source_{name}": mutant for name, mutant in SOURCES.items()},
    **{f"controller_{name}": mutant for name, mutant in CONTROLLERS.items()},
}


def __getattr__(name: str) -> Any:
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
