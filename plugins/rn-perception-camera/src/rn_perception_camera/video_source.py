"""Perception source for USB cameras and video files."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence

import numpy as np

from rn_perception_camera.arrivals import Arrivals
from rn_perception_camera.capture import HANG_LIMIT_S, open_capture
from rn_perception_camera.grabber import Grabbed, Grabber
from rn_perception_camera.options import VideoCameraOptions, VideoCamerasOptions
from rn_perception_camera.preparation import (
    HALF_PIXEL,
    Preparation,
    measured_undistortion,
    prepare,
)
from rn_perception_camera.served import check_cameras
from roboneuron import CameraProfile, ConfigurationError, Frame, NotReadyError, StateError, Topics

_JOIN_S = HANG_LIMIT_S + 1.0


class VideoCameras:
    """Grabs on one thread per camera and keeps the newest image; implements `PerceptionSource`.

    A frame is stamped at the end of grabbing, which is later than its exposure by the latency of
    the camera and the bus.
    """

    def __init__(
        self, config: VideoCamerasOptions | None, topics: Topics, cameras: Sequence[CameraProfile]
    ) -> None:
        self._options = {} if config is None else config.cameras
        self._topics = topics
        self._profiles = {camera.name: camera for camera in cameras}
        periods_s = {
            name: self._options[name].period_s for name in self._profiles if name in self._options
        }
        self._arrivals: Arrivals[Grabbed] = Arrivals(periods_s)
        self._grabbers: dict[str, Grabber] = {}
        self._preparations: dict[str, tuple[tuple[int, int], Preparation]] = {}
        self._newest_ns: dict[str, int] = {}

    def open(self) -> None:
        """Open every camera and start grabbing.

        Raises:
            ConfigurationError: no camera, one without options, a file that is absent or not a
                video, or a size that the device does not have.
            NotReadyError: a device is absent or busy.
            StateError: it is open already, or a camera still hangs since the last `close`.
        """
        check_cameras("video-camera", tuple(self._profiles.values()), self._options)
        for name, profile in self._profiles.items():
            if self._options[name].intrinsics is not None and profile.calibration is None:
                raise ConfigurationError(
                    f"Camera {name!r} has intrinsics, but the robot's profile does not tell where "
                    "it is mounted.",
                    hint=f"Measure it: `roboneuron robot cameras calibrate {name}`. Or leave "
                    "intrinsics out.",
                )
        if any(not grabber.join(0.0) for grabber in self._grabbers.values()):
            raise StateError(
                "The cameras are open, or one of them still hangs.", hint="Call close() and wait."
            )
        self._arrivals.open()
        self._newest_ns.clear()
        self._grabbers = {
            name: self._make_grabber(name, self._options[name]) for name in self._profiles
        }
        try:
            for grabber in self._grabbers.values():
                grabber.start()
        except BaseException:
            self.close()
            raise

    def read(self, timeout_s: float) -> Frame:
        """Return the next frame, of the cameras in turn.

        Raises:
            NotReadyError: none came within `timeout_s`; names the reason for each camera.
            StateError: not open.
        """
        deadline_s = time.monotonic() + timeout_s
        while (taken := self._arrivals.take(deadline_s)) is not None:
            name, grabbed = taken
            if grabbed.stamp_ns >= self._newest_ns.get(name, 0):
                self._newest_ns[name] = grabbed.stamp_ns
                return self._to_frame(name, grabbed)
            self._newest_ns[name] = grabbed.stamp_ns  # the clock was set back
        raise self._explain(timeout_s)

    def close(self) -> None:
        """Stop grabbing and release the cameras; a `read` in progress ends with StateError. May be
        called twice.
        """
        self._arrivals.close()
        for grabber in self._grabbers.values():
            grabber.ask_to_stop()
        deadline_s = time.monotonic() + _JOIN_S
        for grabber in self._grabbers.values():
            grabber.join(max(0.0, deadline_s - time.monotonic()))

    def _make_grabber(self, name: str, options: VideoCameraOptions) -> Grabber:
        loop = None if options.path is None else options.loop
        opener = functools.partial(open_capture, options)
        return Grabber(options.place, loop, opener, self._topics.now_ns, self._delivery(name))

    def _delivery(self, name: str) -> Callable[[Grabbed], None]:
        return lambda grabbed: self._arrivals.put(name, grabbed)

    def _to_frame(self, name: str, grabbed: Grabbed) -> Frame:
        profile = self._profiles[name]
        rgb = np.ascontiguousarray(grabbed.bgr[:, :, ::-1])
        preparation = self._prepare(name, (rgb.shape[1], rgb.shape[0]))
        return Frame(
            camera=name,
            image=preparation.apply(rgb),
            stamp_ns=grabbed.stamp_ns,
            frame_id=profile.frame_id,
            calibration=preparation.calibration,
        )

    def _prepare(self, name: str, size: tuple[int, int]) -> Preparation:
        known = self._preparations.get(name)
        if known is not None and known[0] == size:
            return known[1]
        options = self._options[name]
        profile, intrinsics = self._profiles[name], None
        if options.intrinsics is not None:
            fx, fy, cx, cy = options.intrinsics
            intrinsics = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]) + HALF_PIXEL
        undistortion = measured_undistortion(profile, size, options.distortion, intrinsics)
        preparation = prepare(
            profile, size, options.resize, intrinsics=intrinsics, undistortion=undistortion
        )
        self._preparations[name] = (size, preparation)
        return preparation

    def _explain(self, timeout_s: float) -> NotReadyError:
        parts: list[str] = []
        hints: list[str] = []
        for name, grabber in self._grabbers.items():
            problem = grabber.problem
            if problem is not None:
                parts.append(problem.message)
                hints.append(problem.hint)
            elif self._arrivals.is_held(name):
                parts.append(f"The next image of camera {name!r} is not due yet.")
            else:
                parts.append(
                    f"Camera {name!r} ({self._options[name].place}) is open, but nothing new came."
                )
        return NotReadyError(
            f"No image came within {timeout_s:g} s. {' '.join(parts)}",
            hint=" ".join(dict.fromkeys(hints)),
        )
