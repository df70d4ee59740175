"""Backends with one mistake each."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from mutation import (
    Mutant,
    compute,
    counted,
    forever,
    leave_thread,
    mutants_of,
    mutate,
    noise,
    or_else,
    read_file,
    remembered,
    then,
)

from rn_testing.fakes import InstantBackend
from roboneuron.contract import ActionChunk
from roboneuron.errors import StateError
from roboneuron.plugins.specs import ActionSpace

STILL = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
SHARED: list[bool] = []
but = mutants_of("backend", InstantBackend)


def scaled(chunk, *factors):
    return replace(chunk, actions=chunk.actions * np.array(factors))


def plus(chunk, amount):
    return replace(chunk, actions=chunk.actions + amount * np.eye(7)[0])


def anything():
    return ActionChunk(actions=STILL, step_s=0.1)


def without_check(self, call, observation):
    return anything() if self._loaded else call(observation)


def in_place(self, call, observation):
    image = observation.frames["primary"].image
    image.base[:] = 0
    return call(observation)


def overwrite_joints(self, call, observation):
    chunk = call(observation)
    observation.joints.position.flags.writeable = True
    observation.joints.position[:] = 0
    return chunk


def one_buffer(self, call, observation):
    chunk = call(observation)
    self.buffer = getattr(self, "buffer", chunk.actions.copy())
    self.buffer[:] = chunk.actions + 1e-4 * counted(self)
    object.__setattr__(chunk, "actions", self.buffer)
    return chunk


def keeps_copies(self, call, observation):
    remembered(self, observation.frames["primary"].image.copy())
    return call(observation)


def zeros_for_nan(self, call, observation):
    if observation.joints is not None and not np.isfinite(observation.joints.position).all():
        return anything()
    return call(observation)


def gripper_of_nan(self, call, observation):
    chunk = call(observation)
    return chunk if np.isfinite(observation.gripper_open) else plus(chunk, 0.01)


def drifting(self, call, observation):
    return plus(call(observation), 0.002 * counted(self))


def drifting_slowly(self, call, observation):
    return plus(call(observation), 1e-4 * counted(self))


def any_camera(self, call, observation):
    """Takes the first other camera for a missing primary one."""
    if not observation.frames or "primary" in observation.frames:
        return call(observation)
    return call(replace(observation, frames={"primary": next(iter(observation.frames.values()))}))


def first_frame_only(self, call, observation):
    chunk = call(observation)
    size = observation.frames["primary"].image.shape
    self.size = getattr(self, "size", size)
    np.zeros(self.size) + observation.frames["primary"].image
    return chunk


def flat_image(self, call, observation):
    observation.frames["primary"].image.view().shape = (-1,)
    return call(observation)


def shared_state(self, call):
    SHARED.append(True)
    return call()


def noise_once(self, call, *arguments, **named):
    call(*arguments, **named)
    self.noise = noise(0.01)


MUTANTS: dict[str, Mutant] = {
    "no_reset": Mutant(
        rule="backend/protocol",
        target=mutate(
            object, **dict.fromkeys(("__init__", "load", "predict", "close"), lambda *_, **__: None)
        ),
    ),
    "no_predict": Mutant(
        rule="backend/protocol",
        target=mutate(
            object, **{n: lambda *_, **__: None for n in ("__init__", "load", "reset", "close")}
        ),
    ),
    "constructor_reads_a_file": but(
        "constructor-pure",
        "opens the file",
        __init__=lambda s, call, c, **k: then(call(c), read_file()),
    ),
    "constructor_starts_a_thread": but(
        "constructor-pure", "thread", __init__=lambda s, call, c, **k: then(call(c), leave_thread())
    ),
    "constructor_computes": but(
        "constructor-pure", "computes", __init__=lambda s, call, c, **k: then(call(c), compute())
    ),
    "constructor_loads": but(
        "predict-before-load-refused", __init__=lambda s, call, c, **k: then(call(c), s.load())
    ),
    "options_ignored": but(
        "options-read", "none of the options", __init__=lambda s, call, c, **k: call(None)
    ),
    "one_option_ignored": but(
        "options-read",
        "horizon",
        case={"options": {"horizon": 3, "delta_m": 0.001}},
        predict=lambda s, call, o: then(s._options.delta_m, anything()),
    ),
    "close_needs_load": but(
        "close-before-load", close=lambda s, call: call() if s._loaded else s.predict(None)
    ),
    "close_fails_the_second_time": but(
        "close-releases", close=lambda s, call: call() if counted(s) < 2 else s.predict(None)
    ),
    "close_takes_20_s": but(
        "close-releases",
        "close did not return within 0.3 s",
        case={"limits_s": {"close": 0.3}},
        close=forever,
    ),
    "close_leaves_a_thread": but(
        "close-releases", "leaves behind", load=lambda s, call: then(call(), leave_thread())
    ),
    "second_load_starts_another_thread": but(
        "second-load-safe",
        "leaves behind",
        load=lambda s, call: then(call(), leave_thread() if counted(s) > 1 else None),
    ),
    "second_load_crashes": but(
        "second-load-safe", load=lambda s, call: call() if counted(s) < 2 else [][0]
    ),
    "load_after_close_crashes": but(
        "load-after-close", load=lambda s, call: call() if counted(s) < 2 else [][0]
    ),
    "load_after_close_is_half": but(
        "load-after-close", load=lambda s, call: call() if counted(s) < 2 else None
    ),
    "load_hangs": but(
        "predict-within-horizon",
        "load did not return within 0.3 s",
        case={"limits_s": {"load": 0.3}},
        load=forever,
    ),
    "predict_hangs": but(
        "predict-within-horizon",
        "predict did not return within 0.3 s",
        case={"limits_s": {"predict": 0.3}},
        predict=forever,
    ),
    "predict_takes_3_s": but(
        "predict-quick",
        case={"predict_limit_s": 0.05},
        predict=lambda s, call, o: then(time.sleep(0.2), call(o)),
    ),
    "reset_hangs": but(
        "reset-safe", "reset did not return", case={"limits_s": {"reset": 0.3}}, reset=forever
    ),
    "every_image_is_kept": but(
        "memory-bounded",
        "bytes of memory",
        predict=lambda s, call, o: then(remembered(s, o), call(replace(o))),
    ),
    "every_image_is_copied_and_kept": but("memory-bounded", predict=keeps_copies),
    "every_chunk_is_kept": but("memory-bounded", predict=lambda s, call, o: remembered(s, call(o))),
    "predicts_before_load": but(
        "predict-before-load-refused", predict=lambda s, call, o: or_else(lambda: call(o), anything)
    ),
    "wrong_error_before_load": but(
        "predict-before-load-refused",
        "AttributeError",
        predict=lambda s, call, o: call(o) if s._loaded else s.model,
    ),
    "predicts_after_close": but("predict-after-close-refused", close=lambda s, call: None),
    "millimetres": but(
        "units",
        "millimetres",
        predict=lambda s, call, o: scaled(call(o), 1e3, 1e3, 1e3, 1, 1, 1, 1),
    ),
    "degrees": but(
        "units",
        "degrees",
        predict=lambda s, call, o: replace(call(o), actions=STILL + 2.86 * np.eye(7)[4]),
    ),
    "normalised_actions": but(
        "units", predict=lambda s, call, o: replace(call(o), actions=STILL + 0.8 * np.eye(7)[1])
    ),
    "gripper_signed": but(
        "predict-within-horizon",
        "gripper_open",
        predict=lambda s, call, o: scaled(call(o), 1, 1, 1, 1, 1, 1, -1),
    ),
    "gripper_in_percent": but(
        "predict-within-horizon",
        "gripper_open",
        predict=lambda s, call, o: scaled(call(o), 1, 1, 1, 1, 1, 1, 100),
    ),
    "nan_action": but(
        "predict-within-horizon",
        "non-finite",
        predict=lambda s, call, o: scaled(call(o), np.nan, 1, 1, 1, 1, 1, 1),
    ),
    "six_values": but(
        "predict-within-horizon",
        "shape",
        predict=lambda s, call, o: ActionChunk(actions=np.zeros((1, 6)), step_s=0.1),
    ),
    "step_of_another_rate": but(
        "step-declared", predict=lambda s, call, o: replace(call(o), step_s=0.05)
    ),
    "step_in_milliseconds": but(
        "step-declared", predict=lambda s, call, o: replace(call(o), step_s=100.0)
    ),
    "step_of_the_descriptor_wrong": but(
        "step-declared", spec={"action_space": ActionSpace(horizon=16, step_s=0.5)}
    ),
    "step_option_ignored": but(
        "step-declared",
        case={"options": {"step_s": 0.2}},
        predict=lambda s, call, o: replace(call(o), step_s=0.1),
    ),
    "chunk_longer_than_the_horizon": but(
        "predict-within-horizon",
        "horizon",
        predict=lambda s, call, o: replace(call(o), actions=np.repeat(STILL, 17, axis=0)),
    ),
    "array_instead_of_a_chunk": but(
        "predict-within-horizon", predict=lambda s, call, o: call(o).actions
    ),
    "nothing_returned": but(
        "predict-within-horizon", predict=lambda s, call, o: then(call(o), None)
    ),
    "reads_an_undeclared_camera": but(
        "predict-within-horizon", predict=lambda s, call, o: then(o.frames["wrist"], call(o))
    ),
    "declares_no_state_and_reads_it": but("predict-within-horizon", spec={"needs_state": False}),
    "declares_state_and_ignores_it": but("missing-state-refused", predict=without_check),
    "declares_a_camera_and_ignores_it": but(
        "missing-frame-refused", spec={"cameras": ("primary", "wrist")}
    ),
    "missing_frame_crashes": but(
        "missing-frame-refused",
        "KeyError",
        predict=lambda s, call, o: then(o.frames["primary"], call(o)),
    ),
    "missing_frame_is_zero_action": but(
        "missing-frame-refused",
        predict=lambda s, call, o: call(o) if o.frames or not s._loaded else anything(),
    ),
    "missing_frame_is_a_state_error": but(
        "missing-frame-refused",
        "StateError",
        predict=lambda s, call, o: call(o) if "primary" in o.frames else raise_state(),
    ),
    "any_camera_stands_in": but("missing-frame-refused", "overhead", predict=any_camera),
    "an_optional_camera_stands_in": but(
        "missing-frame-refused",
        "wrist",
        spec={"optional_cameras": ("wrist",)},
        predict=lambda s, call, o: any_camera(s, call, o) if "wrist" in o.frames else call(o),
    ),
    "optional_camera_crashes": but(
        "optional-frames-used",
        spec={"optional_cameras": ("wrist",)},
        predict=lambda s, call, o: call(o) if len(o.frames) == 1 else [][0],
    ),
    "nan_state_is_zero_action": but("nan-state-refused", predict=zeros_for_nan),
    "nan_opening_is_acted_on": but("nan-state-refused", "gripper opening", predict=gripper_of_nan),
    "text_in_the_metrics": but(
        "metrics-numeric", predict=lambda s, call, o: replace(call(o), metrics={"state": "fine"})
    ),
    "note_of_two_lines": but(
        "metrics-numeric", predict=lambda s, call, o: replace(call(o), note="one\ntwo")
    ),
    "reset_breaks": but("reset-safe", reset=lambda s, call: s.close()),
    "reset_only_once": but("reset-safe", reset=lambda s, call: None if counted(s) < 3 else [][0]),
    "reset_forgets_nothing": but("reset-forgets", predict=drifting),
    "reset_forgets_no_small_drift": but("reset-forgets", predict=drifting_slowly),
    "noise": but("reset-forgets", predict=lambda s, call, o: plus(call(o), noise(0.01))),
    "noise_of_the_instance": but(
        "repeatable", __init__=noise_once, predict=lambda s, call, o: plus(call(o), s.noise)
    ),
    "time_in_the_action": but(
        "reset-forgets",
        predict=lambda s, call, o: plus(call(o), time.monotonic() + 0.01 * counted(s)),
    ),
    "class_counts_loads": but(
        "repeatable",
        load=shared_state,
        predict=lambda s, call, o: plus(call(o), 0.002 * len(SHARED)),
    ),
    "answers_share_one_buffer": but("chunk-kept", predict=one_buffer),
    "image_written_to": but("input-kept", predict=in_place),
    "image_painted": but(
        "input-kept", predict=lambda s, call, o: then(o.frames["primary"].image.fill(0), call(o))
    ),
    "joints_written_to": but("input-kept", predict=overwrite_joints),
    "frames_taken_away": but(
        "input-kept", predict=lambda s, call, o: then(call(o), o.frames.clear(), anything())
    ),
    "only_the_first_size": but("any-image-size", "ValueError", predict=first_frame_only),
    "only_landscape": but(
        "any-image-size",
        predict=lambda s, call, o: then(
            1 / max(0, o.frames["primary"].image.shape[1] - o.frames["primary"].image.shape[0]),
            call(o),
        ),
    ),
    "only_contiguous_images": but("any-image-size", "contiguous", predict=flat_image),
}


def raise_state():
    raise StateError("no frame")


def __getattr__(name):
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
