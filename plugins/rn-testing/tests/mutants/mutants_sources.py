"""Perception sources with one mistake each."""

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
    or_else,
    read_file,
    remembered,
    then,
)

from rn_testing.fakes import ControlledSource
from roboneuron.contract import Frame
from roboneuron.errors import NotReadyError

NS = 1_000_000_000
but = mutants_of("perception", ControlledSource)


def framed(**changes):
    """`read` with a changed frame."""

    def read(self, call, timeout_s):
        frame = call(timeout_s)
        return replace(frame, **{name: change(self, frame) for name, change in changes.items()})

    return read


def seen(change):
    return framed(image=lambda s, f: np.ascontiguousarray(change(f.image)))


def one_buffer(self, frame):
    self.buffer = getattr(self, "buffer", frame.image.copy())
    self.buffer[:] = frame.image
    return self.buffer


def two_buffers(self, frame):
    self.buffers = getattr(self, "buffers", [frame.image.copy(), frame.image.copy()])
    buffer = self.buffers[counted(self) % 2]
    buffer[:] = frame.image
    return buffer


def painted_later(self, call, timeout_s):
    frame = call(timeout_s)
    if hasattr(self, "last"):
        self.last[0, 0] = 99
    self.last = frame.image.copy()
    return replace(frame, image=self.last)


def late(self, call, timeout_s):
    try:
        return call(timeout_s)
    except NotReadyError:
        time.sleep(1.0)
        raise


def impatient(self, call, timeout_s):
    return call(0.0)


def nothing_when_late(self, call, timeout_s):
    return or_else(lambda: call(timeout_s), lambda: None if self._is_open else call(timeout_s))


def blank_when_late(self, call, timeout_s):
    camera = next(iter(self._cameras.values()), None)
    blank = np.zeros((48, 64, 3), np.uint8)
    return or_else(
        lambda: call(timeout_s) if self._is_open else then(),
        lambda: Frame(camera=camera.name, image=blank, stamp_ns=1, frame_id=camera.frame_id),
    )


def second_open_starts_another_thread(self, call):
    call()
    if counted(self) > 1:
        leave_thread()


class Streaming(ControlledSource):
    """A good source whose frames arrive by themselves, with the cameras in rotation."""

    def read(self, timeout_s):
        if self._is_open and not self._pending and self._cameras:
            time.sleep(0.002)
            names = list(self._cameras)
            self.show(names[counted(self) % len(names)])
        return super().read(timeout_s)


def half_of_the_cameras(self, call, config, topics, cameras):
    call(config, topics, cameras[:1])


MUTANTS: dict[str, Mutant] = {
    "no_read": Mutant(
        rule="perception/protocol",
        target=mutate(object, **{n: lambda *_: None for n in ("__init__", "open", "close")}),
    ),
    "constructor_reads_a_file": but(
        "constructor-pure", __init__=lambda s, call, *a: then(call(*a), read_file())
    ),
    "constructor_starts_a_thread": but(
        "constructor-pure", __init__=lambda s, call, *a: then(call(*a), leave_thread())
    ),
    "constructor_computes": but(
        "constructor-pure", __init__=lambda s, call, *a: then(call(*a), compute())
    ),
    "constructor_subscribes": but(
        "constructor-leaves-topics",
        __init__=lambda s, call, c, t, p: then(call(c, t, p), t.subscribe("a", object, print)),
    ),
    "constructor_opens": but(
        "read-before-open-refused", __init__=lambda s, call, *a: then(call(*a), s.open())
    ),
    "options_ignored": but(
        "options-read", spec={"config": "rn_testing.fakes.backend:InstantOptions"}
    ),
    "close_needs_open": but(
        "close-before-open", close=lambda s, call: call() if s._is_open else s.read(0)
    ),
    "close_takes_20_s": but(
        "close-releases", "close did not return", case={"limits_s": {"close": 0.3}}, close=forever
    ),
    "close_leaves_a_thread": but(
        "close-releases", open=lambda s, call: then(call(), leave_thread())
    ),
    "second_open_starts_another_thread": but(
        "second-open-safe", open=second_open_starts_another_thread
    ),
    "second_open_crashes": but(
        "second-open-safe", open=lambda s, call: call() if counted(s) < 2 else [][0]
    ),
    "open_after_close_is_half": but(
        "open-after-close", open=lambda s, call: call() if counted(s) < 2 else None
    ),
    "open_hangs": but(
        "frame-of-a-camera", "open did not return", case={"limits_s": {"open": 0.3}}, open=forever
    ),
    "reads_before_open": but("read-before-open-refused", read=blank_when_late),
    "reads_after_close": but("read-after-close-refused", close=lambda s, call: None),
    "read_hangs": but(
        "read-bounded", "did not return", case={"limits_s": {"read": 0.3}}, read=forever
    ),
    "read_waits_a_second_longer": but("read-bounded", read=late),
    "read_ignores_its_timeout": but("read-bounded", read=lambda s, call, t: call(1.5)),
    "read_waits_whole_seconds": but("read-bounded", read=lambda s, call, t: call(max(t, 1.0))),
    "read_does_not_wait": but("read-waits", read=impatient),
    "read_takes_milliseconds": but("read-waits", read=lambda s, call, t: call(t / 1000)),
    "read_returns_none_when_late": but("read-bounded", "NoneType", read=nothing_when_late),
    "array_instead_of_a_frame": but("frame-of-a-camera", read=lambda s, call, t: call(t).image),
    "another_camera": but("frame-of-a-camera", read=framed(camera=lambda s, f: "somewhere")),
    "frame_id_empty": but("frame-of-a-camera", read=framed(frame_id=lambda s, f: "")),
    "frame_id_of_the_camera": but("frame-of-a-camera", read=framed(frame_id=lambda s, f: f.camera)),
    "frame_id_later_wrong": but(
        "frame-of-a-camera",
        read=framed(frame_id=lambda s, f: f.frame_id if counted(s) < 3 else "map"),
    ),
    "half_size": but("frame-of-a-camera", "32x24", read=seen(lambda i: i[::2, ::2])),
    "width_and_height_swapped": but(
        "frame-of-a-camera", "48x64", read=seen(lambda i: i.transpose(1, 0, 2))
    ),
    "cropped": but("frame-of-a-camera", read=seen(lambda i: i[:, 8:-8])),
    "red_and_blue_swapped": but(
        "frame-expected", "red and blue", read=seen(lambda i: i[:, :, ::-1])
    ),
    "upside_down": but("frame-expected", read=seen(lambda i: i[::-1])),
    "mirrored": but("frame-expected", read=seen(lambda i: i[:, ::-1])),
    "black": but("frame-expected", read=seen(lambda i: 0 * i)),
    "grey": but(
        "frame-expected",
        read=seen(lambda i: np.repeat(i.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8)),
    ),
    "calibration_of_another_camera": but(
        "calibration-kept",
        read=framed(
            calibration=lambda s, f: (
                replace(f.calibration, intrinsics=2 * f.calibration.intrinsics)
                if f.calibration
                else None
            )
        ),
    ),
    "calibration_mount_lost": but(
        "calibration-kept",
        read=framed(
            calibration=lambda s, f: (
                replace(f.calibration, T_mount_camera=np.eye(4) * 2) if f.calibration else None
            )
        ),
    ),
    "stamp_zero": but("stamps-in-ros-time", read=framed(stamp_ns=lambda s, f: 0)),
    "stamp_in_seconds": but(
        "stamps-in-ros-time", read=framed(stamp_ns=lambda s, f: f.stamp_ns // NS)
    ),
    "stamp_in_microseconds": but(
        "stamps-in-ros-time", read=framed(stamp_ns=lambda s, f: f.stamp_ns // 1000)
    ),
    "stamp_monotonic": but(
        "stamps-in-ros-time", read=framed(stamp_ns=lambda s, f: time.monotonic_ns())
    ),
    "stamp_of_the_wall_clock": but(
        "stamps-in-ros-time", read=framed(stamp_ns=lambda s, f: time.time_ns())
    ),
    "stamp_in_the_future": but(
        "stamps-in-ros-time", "future", read=framed(stamp_ns=lambda s, f: f.stamp_ns + NS // 2)
    ),
    "stamp_of_an_old_frame": but(
        "stamps-in-ros-time", read=framed(stamp_ns=lambda s, f: f.stamp_ns - 10 * NS)
    ),
    "stamp_of_the_read": but(
        "stamps-of-capture", read=framed(stamp_ns=lambda s, f: s._topics.now_ns())
    ),
    "stamps_go_back": but(
        "frames-in-order", read=framed(stamp_ns=lambda s, f: f.stamp_ns - NS * counted(s))
    ),
    "stamp_stays": but(
        "frames-in-order",
        read=framed(stamp_ns=lambda s, f: s.__dict__.setdefault("first", f.stamp_ns)),
    ),
    "frames_share_one_buffer": but("frames-own-memory", read=framed(image=one_buffer)),
    "frames_share_two_buffers": but("frames-own-memory", read=framed(image=two_buffers)),
    "frame_painted_later": but("frames-own-memory", read=painted_later),
    "every_frame_is_kept": but("memory-bounded", read=lambda s, call, t: remembered(s, call(t))),
    "one_camera_never_comes": Mutant(
        rule="perception/every-camera-served",
        target=mutate(Streaming, __init__=half_of_the_cameras),
        case={"feed": None},
    ),
    "no_cameras_crash": but(
        "no-cameras-refused",
        "StopIteration",
        open=lambda s, call: next(iter(s._cameras.values())) and call(),
    ),
}


def __getattr__(name):
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
