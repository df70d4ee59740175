"""Mistakes collected independently of the rules; no rule is named for them, and some are not
detected.

`benchmarks/bench_contract_kit.py` counts how many of them are detected by any rule of their kind.
"""

from __future__ import annotations

import subprocess
import threading
import time
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from mutation import Mutant, counted, mutate, then

from rn_testing.fakes import (
    ControlledSource,
    CountingRuntime,
    FakeDecoder,
    FakeDriver,
    GantryController,
    HalvingAcceleration,
    InstantBackend,
)
from roboneuron.contract import Hold

BASES = {
    "backend": InstantBackend,
    "runtime": CountingRuntime,
    "perception": ControlledSource,
    "controller": GantryController,
    "driver": FakeDriver,
    "acceleration": HalvingAcceleration,
}


def one(kind: str, **changes: Any) -> Mutant:
    return Mutant(rule=f"{kind}/?", target=mutate(BASES[kind], **changes))


def batched(self, call, observation):
    chunk = call(observation)
    object.__setattr__(chunk, "actions", chunk.actions[None])
    return chunk


def after_close(self, call):
    call()
    self._loaded = True


def elbow_flips(self, call, action, joints, step_s):
    result = call(action, joints, step_s)
    if isinstance(result, Hold) or abs(action.translation_m[0]) < 1e-9:
        return result
    turned = result.position.copy()
    turned[3:6] += [np.pi, np.pi - 2 * turned[4], np.pi]
    return replace(result, position=turned)


def history(self, call, action, joints, step_s):
    result = call(action, joints, step_s)
    if isinstance(result, Hold):
        return result
    self.last = getattr(self, "last", result.position)
    self.last = (
        0.5 * (self.last + result.position)
        if self.last.shape == result.position.shape
        else result.position
    )
    return replace(result, position=self.last)


def only_upwards(self, call, command):
    """Does not move a joint that is to go down by less than a degree."""
    here = self._positions()
    kept = [
        here[n] if 0 < here[n] - p < 0.01 else p
        for n, p in zip(command.names, command.position, strict=True)
    ]
    return replace(call(replace(command, position=np.array(kept))), position=command.position)


def third_time_lucky(self, call, request):
    if counted(self) % 50 == 0:
        raise RuntimeError("lost the worker")
    return call(request)


def child(self, call, *arguments, **named):
    self.child = subprocess.Popen(["sleep", "5"])
    return call(*arguments, **named)


def clips_in_place(self, call, command):
    if self._start:
        command.position.flags.writeable = True
        command.position += 1e-6
    return call(command)


def first_jump(self, call, command):
    sent = call(command)
    if counted(self) == 1:
        self._duration_s = 0.0
    return sent


def widened_limits(self, call):
    call()
    self._profile.limits.upper.flags.writeable = True
    self._profile.limits.upper[:] += 0.1


def about_the_base(self, call, action, joints, step_s):
    """Turns the TCP about the origin of the base."""
    result = call(action, joints, step_s)
    turn = action.rotation_rad
    if isinstance(result, Hold) or not np.any(turn):
        return result
    position = result.position.copy()
    position[:3] += np.cross(turn, self._measured(joints)[:3])
    return replace(result, position=position)


def opens_gripper_when_still(self, call, action, joints, step_s):
    result = call(action, joints, step_s)
    if isinstance(result, Hold) or np.any(action.to_vector()[:6]):
        return result
    return replace(result, position=np.append(result.position[:6], 0.04))


def of_this_thread(self, call, observation):
    """Knows its model in the thread of `load` only."""
    if not hasattr(LOCAL, "model"):
        raise RuntimeError("no model in this thread")
    return call(observation)


def stale_after_long_pause(self, call, timeout_s):
    begun = getattr(self, "begun", time.monotonic())
    self.begun = begun
    frame = call(timeout_s)
    return (
        replace(frame, stamp_ns=frame.stamp_ns - 2_000_000_000)
        if time.monotonic() - begun > 30
        else frame
    )


LOCAL = threading.local()
TOLD: list[str] = []

MUTANTS: dict[str, Mutant] = {
    "backend_of_one_thread": one(
        "backend",
        load=lambda s, call: then(setattr(LOCAL, "model", 1), call()),
        predict=of_this_thread,
    ),
    "backend_remembers_in_the_class": one(
        "backend",
        predict=lambda s, call, o: then(
            TOLD.append(o.instruction),
            replace(call(o), actions=call(o).actions + 1e-3 * len(TOLD) * np.eye(7)[0]),
        ),
    ),
    "backend_step_of_the_clock": one(
        "backend", predict=lambda s, call, o: replace(call(o), step_s=0.1 + 1e-3 * counted(s))
    ),
    "driver_writes_into_the_command": one("driver", send=clips_in_place),
    "driver_jumps_at_the_first_command": one("driver", send=first_jump),
    "driver_velocity_always_zero": one(
        "driver",
        read=lambda s, call: (
            lambda state: replace(
                state, joints=replace(state.joints, velocity=0 * state.joints.velocity)
            )
        )(call()),
    ),
    "controller_widens_limits": one("controller", load=widened_limits),
    "controller_turns_about_the_base": one("controller", compute=about_the_base),
    "controller_opens_the_gripper_when_still": one("controller", compute=opens_gripper_when_still),
    "perception_blue_for_red": one(
        "perception",
        read=lambda s, call, t: (lambda f: replace(f, image=f.image[..., ::-1]))(call(t)),
    ),
    "perception_mirrored": one(
        "perception",
        read=lambda s, call, t: (lambda f: replace(f, image=f.image[:, ::-1]))(call(t)),
    ),
    "perception_without_a_frame": one(
        "perception", read=lambda s, call, t: replace(call(t), frame_id="")
    ),
    "backend_chunk_in_a_batch": one("backend", predict=batched),
    "backend_warns_each_time": one(
        "backend", predict=lambda s, call, o: then(warnings.warn("slow", stacklevel=2), call(o))
    ),
    "backend_predicts_after_close": one("backend", close=after_close),
    "backend_leaves_a_child": one("backend", load=child),
    "backend_hangs_on_the_hundredth": one(
        "backend", predict=lambda s, call, o: time.sleep(2) if counted(s) == 100 else call(o)
    ),
    "backend_rows_written_later": one(
        "backend",
        reset=lambda s, call: then(setattr(s, "noise", counted(s)), call()),
        predict=lambda s, call, o: replace(
            call(o),
            actions=call(o).actions + np.array([0.002 * getattr(s, "noise", 0), 0, 0, 0, 0, 0, 0]),
        ),
    ),
    "runtime_lies_now_and_then": one("runtime", run=third_time_lucky),
    "runtime_loses_the_type": one("runtime", run=lambda s, call, r: float(call(r))),
    "runtime_answers_a_view": one(
        "runtime",
        run=lambda s, call, r: then(
            s.__dict__.setdefault("out", np.zeros(1)).__setitem__(0, call(r)), s.out
        ),
    ),
    "perception_repeats_a_frame": one(
        "perception",
        read=lambda s, call, t: then(
            s.__dict__.__setitem__("f", call(t)),
            s._pending.append(s.f) if counted(s) == 1 else 0,
            s.f,
        ),
    ),
    "perception_stamps_drift_after_a_pause": one("perception", read=stale_after_long_pause),
    "controller_elbow_flips": one("controller", compute=elbow_flips),
    "controller_smooths": one("controller", compute=history),
    "controller_stretches_time": one(
        "controller",
        compute=lambda s, call, a, j, t: (
            lambda r: r if isinstance(r, Hold) else replace(r, duration_s=3 * r.duration_s)
        )(call(a, j, t)),
    ),
    "driver_stuck_downwards": one("driver", send=only_upwards),
    "driver_tells_the_command": one("driver", send=lambda s, call, c: then(call(c), c)),
    "acceleration_patches_the_class": one(
        "acceleration",
        apply=lambda s, call, d: then(call(d), setattr(FakeDecoder, "patched", counted(s))),
    ),
}


def __getattr__(name: str) -> Any:
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
