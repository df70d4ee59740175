"""Mistakes of authors that were written down before a rule for them was looked for.

Each names the rule that detects it now. `benchmarks/bench_contract_kit.py` counts them.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from mutants_processes import BASES, doing
from mutation import Mutant, counted, mutate, then

from rn_testing.fakes import (
    ControlledSource,
    CountingRuntime,
    FakeDriver,
    GantryController,
    HalvingAcceleration,
    InstantBackend,
)
from roboneuron.contract import Hold, RobotState
from roboneuron.errors import InvalidInputError, NotReadyError, StateError

log = logging.getLogger(__name__)


def one(kind: str, rule: str, base: type, case: dict[str, object] | None = None, **changes: Any):
    return Mutant(rule=f"{kind}/{rule}", target=mutate(base, **changes), case=case or {})


def backend(rule: str, **changes: Any) -> Mutant:
    return one("backend", rule, InstantBackend, **changes)


def runtime(rule: str, **changes: Any) -> Mutant:
    return one("runtime", rule, CountingRuntime, **changes)


def perception(rule: str, **changes: Any) -> Mutant:
    return one("perception", rule, ControlledSource, **changes)


def controller(rule: str, **changes: Any) -> Mutant:
    return one("controller", rule, GantryController, **changes)


def driver(rule: str, **changes: Any) -> Mutant:
    return one("driver", rule, FakeDriver, **changes)


def acceleration(rule: str, **changes: Any) -> Mutant:
    return one("acceleration", rule, HalvingAcceleration, **changes)


def plus(chunk, amount):
    return replace(chunk, actions=chunk.actions + amount * np.eye(7)[0])


def off(result, amount):
    if isinstance(result, Hold):
        return result
    return replace(result, position=result.position + amount * np.eye(len(result.position))[0])


def with_a_thread(self, call, *arguments, **named):
    """Each use starts a thread, all of which end with `close`."""
    self.ended = getattr(self, "ended", None) or threading.Event()
    threading.Thread(target=self.ended.wait, args=(20,), daemon=True).start()
    return call(*arguments, **named)


def end_threads(self, call):
    call()
    if hasattr(self, "ended"):
        self.ended.set()


def growing(kind: str) -> Mutant:
    base, _, use = BASES[kind]
    use = "read" if kind == "driver" else use
    return one(kind, "memory-bounded", base, **{use: with_a_thread}, close=end_threads)


def begun_here(self, call, *arguments, **named):
    self.thread = threading.get_ident()
    return call(*arguments, **named)


def only_here(self, call, *arguments, **named):
    """Works in the thread of its start only, as SQLite and some camera libraries do."""
    if getattr(self, "thread", threading.get_ident()) != threading.get_ident():
        raise RuntimeError("called from another thread")
    return call(*arguments, **named)


def of_one_thread(kind: str) -> Mutant:
    base, begin, use = BASES[kind]
    return one(kind, "any-thread", base, **{begin: begun_here, use: only_here})


def noisy(kind: str, act: Callable[[], object], use: str = "") -> Mutant:
    base, _, usual = BASES[kind]
    return one(kind, "quiet", base, **doing(use or usual, act))


def first_takes_long(self, call, observation):
    """Reads its weights with the first prediction."""
    if counted(self) == 1:
        time.sleep(0.4)
    return call(observation)


class Running(InstantBackend):
    """A good backend whose numbers come from its runtime."""

    def __init__(self, config, runtime=None, acceleration=None):
        super().__init__(config)
        self.runtime, self.acceleration = runtime, acceleration

    def load(self):
        self.runtime.load("model", self.acceleration)
        super().load()

    def predict(self, observation):
        chunk = super().predict(observation)
        return plus(chunk, 1e-3 * self.runtime.run("move to it"))

    def close(self):
        super().close()
        if self.runtime is not None:
            self.runtime.close()


def running(rule: str, *, accelerated: bool = False, **changes: Any) -> Mutant:
    case: dict[str, object] = {"runtime": lambda: CountingRuntime(None)}
    if accelerated:
        case["acceleration"] = lambda: HalvingAcceleration(None)
    return one("backend", rule, Running, case=case, **changes)


def stale_after_a_while(self, call, timeout_s):
    """Counts its stamps with a clock of its own, which goes slower."""
    frame = call(timeout_s)
    self.begun_s = getattr(self, "begun_s", time.monotonic())
    lost_ns = int(1e6 * (time.monotonic() - self.begun_s))
    return replace(frame, stamp_ns=frame.stamp_ns - lost_ns)


def last_chunk_again(self, call, observation):
    """Repeats the last chunk if its runtime fails."""
    try:
        self.last = call(observation)
    except StateError:
        raise
    except Exception:
        if not hasattr(self, "last"):
            self.last = InstantBackend.predict(self, observation)
    return self.last


def another_error(self, call, observation):
    """Tells each failure of its runtime as a wrong input."""
    try:
        return call(observation)
    except NotReadyError as error:
        raise InvalidInputError(str(error)) from error


def one_answer_late(self, call, request):
    """After `abort` it answers what was asked before, as a queue does that was not emptied."""
    answer = call(request)
    if self.__dict__.pop("late", False) and hasattr(self, "before"):
        return self.before
    self.before = answer
    return answer


def refused_otherwise(self, call, model, preset=None):
    try:
        call(model, preset)
    except InvalidInputError as error:
        if isinstance(model, str):
            raise NotReadyError("The model could not be loaded.") from error
        raise


def still_accelerated(self, call, model, preset=None):
    self.preset = getattr(self, "preset", None) or preset
    call(model, self.preset)


def applied_to_all(self, call, decoder):
    """Each further `apply` of one preset changes the decoders before."""
    call(decoder)
    for earlier in self.__dict__.setdefault("decoders", [])[-3:]:
        if earlier is not decoder:
            earlier.kept_fraction *= 0.5
    self.decoders.append(decoder)


def forgotten(self, call, decoder):
    threading.Thread(target=time.sleep, args=(7,), daemon=True).start()
    call(decoder)


def shared_command(self, call, action, joints, step_s):
    result = call(action, joints, step_s)
    if isinstance(result, Hold):
        return result
    self.shared = getattr(self, "shared", np.zeros(len(result.position)))
    if self.shared.shape != result.position.shape:
        return result
    self.shared[:] = result.position
    object.__setattr__(result, "position", self.shared)
    return result


def shared_pose(self, call, joints):
    pose = call(joints)
    self.pose = getattr(self, "pose", np.zeros(3))
    self.pose[:] = pose.position_m
    object.__setattr__(pose, "position_m", self.pose)
    return pose


def goes_on_after_open(self, call):
    """`close` does not stop the motion, and `open` finds the robot still on its way."""
    left = getattr(self, "left", None)
    call()
    if left is not None:
        goal, rest_s = left
        self._move(self._positions(), goal, max(rest_s, 0.5))


def leaves_moving(self, call):
    if self._start is not None:
        self.left = (self._goal, self._duration_s - (time.monotonic() - self._begun_s))
    call()


def first_names_win(self, call, command):
    """Takes the first of two positions for one joint."""
    if len(set(command.names)) < len(command.names):
        kept = {n: i for i, n in reversed(list(enumerate(command.names)))}
        command = replace(
            command, names=tuple(kept), position=command.position[list(kept.values())]
        )
    return call(command)


def any_opening(self, call, command):
    """Does not check how far the gripper opens."""
    if self._start and "finger" in command.names and len(command.names) == len(command.position):
        at = command.names.index("finger")
        inside = command.position.copy()
        inside[at] = np.clip(inside[at], 0.0, 0.04)
        return replace(call(replace(command, position=inside)), position=command.position)
    return call(command)


def waits_while_moving(self, call):
    if self._start and time.monotonic() - self._begun_s < self._duration_s:
        time.sleep(0.04)
    return call()


def toggles(self, call):
    """A second `hold` releases the first."""
    if self._start is not None and counted(self) % 2 == 0:
        here = self._positions()
        return self._move(here, {n: p + 0.1 for n, p in here.items()}, 1.0)
    return call()


def whole_seconds(self, call, command):
    """Moves in whole seconds, as its robot's interface wants them."""
    sent = call(command)
    if sent.duration_s >= 1.0:
        self._duration_s = float(int(sent.duration_s))
    return sent


def still_fast(self, call):
    """The velocity of the last motion stands while the arm does."""
    state: RobotState = call()
    speed = np.array([self._goal[n] - self._start[n] for n in state.joints.names])
    if not np.any(speed):
        speed = getattr(self, "speed", speed)
    self.speed = speed
    return replace(state, joints=replace(state.joints, velocity=speed))


MUTANTS: dict[str, Mutant] = {
    "backend_joints_by_place": backend(
        "inputs-by-name",
        predict=lambda s, call, o: plus(call(o), 1e-2 * float(o.joints.position[0])),
    ),
    "backend_counts_in_absolute_time": backend(
        "clock-free",
        predict=lambda s, call, o: plus(call(o), 0.01 * np.sin(o.stamp_ns / 1e9)),
    ),
    "backend_refuses_images_of_another_clock": backend(
        "clock-free",
        predict=lambda s, call, o: (lambda c: then(1 / (o.stamp_ns < 1e18), c))(call(o)),
    ),
    "backend_drifts_after_a_while": backend(
        "reset-forgets",
        predict=lambda s, call, o: plus(call(o), 2e-3 * max(0, counted(s) - 80)),
    ),
    "backend_loads_at_the_first_prediction": one(
        "backend",
        "first-predict-quick",
        InstantBackend,
        case={"predict_limit_s": 0.3},
        predict=first_takes_long,
    ),
    "backend_repeats_when_its_runtime_fails": running(
        "runtime-errors-kept", predict=last_chunk_again
    ),
    "backend_error_of_its_runtime_loses_its_type": running(
        "runtime-errors-kept", predict=another_error
    ),
    "backend_does_not_pass_its_acceleration_on": running(
        "acceleration-passed-on",
        accelerated=True,
        load=lambda s, call: then(setattr(s, "acceleration", None), call()),
    ),
    "backend_logs_each_time": noisy("backend", lambda: log.warning("predicting")),
    "backend_writes_to_stderr_each_time": noisy(
        "backend", lambda: print("predicting", file=sys.stderr)
    ),
    "runtime_logs_each_run": noisy("runtime", lambda: log.warning("running")),
    "perception_logs_each_read": noisy("perception", lambda: log.warning("reading")),
    "perception_stamps_drift_after_a_while": perception(
        "stamps-do-not-drift", read=stale_after_a_while
    ),
    "controller_warns_each_time": noisy("controller", lambda: warnings.warn("slow", stacklevel=2)),
    "driver_logs_each_read": noisy("driver", lambda: log.error("reading"), "read"),
    **{f"{kind}_starts_a_thread_with_each_use": growing(kind) for kind in BASES},
    **{f"{kind}_works_in_one_thread": of_one_thread(kind) for kind in BASES},
    "runtime_answers_one_late_after_abort": runtime(
        "abort-harmless",
        abort=lambda s, call: then(call(), setattr(s, "late", True)),
        run=one_answer_late,
    ),
    "runtime_refusal_of_its_acceleration_loses_its_type": runtime(
        "acceleration-accepted", load=refused_otherwise
    ),
    "runtime_keeps_its_acceleration": runtime("acceleration-contained", load=still_accelerated),
    "acceleration_changes_earlier_decoders": acceleration("applies-again", apply=applied_to_all),
    "acceleration_leaves_a_thread": acceleration("releases", apply=forgotten),
    "controller_commands_share_an_array": controller("answers-kept", compute=shared_command),
    "controller_poses_share_an_array": controller("answers-kept", forward=shared_pose),
    "controller_needs_velocities": controller(
        "bad-numbers-hold",
        compute=lambda s, call, a, j, t: (
            lambda r: r if isinstance(r, Hold) else then(j.velocity.sum(), r)
        )(call(a, j, t)),
    ),
    "controller_counts_in_absolute_time": controller(
        "memoryless",
        compute=lambda s, call, a, j, t: off(call(a, j, t), 1e-4 * np.sin(j.stamp_ns / 1e9)),
    ),
    "controller_drifts_after_a_while": controller(
        "memoryless",
        compute=lambda s, call, a, j, t: off(call(a, j, t), 1e-5 * max(0, counted(s) - 100)),
    ),
    "driver_goes_on_when_opened_again": driver(
        "open-stands-still", open=goes_on_after_open, close=leaves_moving
    ),
    "driver_takes_a_joint_twice": driver("bad-command-refused", send=first_names_win),
    "driver_gripper_beyond_its_travel": driver("limits-kept", send=any_opening),
    "driver_read_waits_while_moving": driver("read-quick", read=waits_while_moving),
    "driver_hold_takes_its_time": driver(
        "hold-quick", hold=lambda s, call: then(call(), time.sleep(0.4))
    ),
    "driver_second_hold_releases": driver("hold-stops", hold=toggles),
    "driver_moves_in_whole_seconds": driver("duration-kept", send=whole_seconds),
    "driver_velocity_stays_when_it_stands": driver("velocity-measured", read=still_fast),
}


def __getattr__(name: str) -> object:
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
