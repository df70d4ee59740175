"""Perception source for cameras whose driver publishes images on ROS topics."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from rn_perception_camera.arrivals import Arrivals
from rn_perception_camera.options import RosCamerasOptions
from rn_perception_camera.ros_feed import Arrival, CameraFeed
from rn_perception_camera.served import check_cameras
from roboneuron import CameraProfile, Frame, NotReadyError, Topics


class RosCameras:
    """Returns the newest image of each camera's topic; implements `PerceptionSource`.

    Drivers may start and stop at any time, reliable or best effort; images keep their capture
    stamps.
    """

    def __init__(
        self, config: RosCamerasOptions | None, topics: Topics, cameras: Sequence[CameraProfile]
    ) -> None:
        self._options = {} if config is None else config.cameras
        self._topics = topics
        self._cameras = tuple(cameras)
        served = [camera for camera in self._cameras if camera.name in self._options]
        self._arrivals: Arrivals[Arrival] = Arrivals(
            {c.name: self._options[c.name].period_s for c in served}
        )
        self._feeds = {
            c.name: CameraFeed(c, self._options[c.name], topics, self._delivery(c.name))
            for c in served
        }
        self._subscribed = False

    def open(self) -> None:
        """Subscribe to the cameras' topics; drivers may start later.

        Raises:
            ConfigurationError: no camera, one without options, one whose mount is not known though
                camera_info is given, a type that is unknown, or a topic that is published with
                another one.
            StateError: it is open already.
        """
        check_cameras("ros-camera", self._cameras, self._options)
        for feed in self._feeds.values():
            feed.check()
        self._arrivals.open()
        if not self._subscribed:
            self._subscribed = True
            for feed in self._feeds.values():
                feed.subscribe()

    def read(self, timeout_s: float) -> Frame:
        """Return the next frame, of the cameras in turn.

        Raises:
            NotReadyError: none came within `timeout_s`; names the reason for each camera.
            StateError: not open.
            InvalidInputError: a damaged image, an unknown encoding, a bad stamp, or a message
                without its image; that message is dropped.
            ConfigurationError: a topic has another type, or a camera_info cannot be used.
        """
        deadline_s = time.monotonic() + timeout_s
        while (taken := self._arrivals.take(deadline_s)) is not None:
            name, arrival = taken
            frame = self._feeds[name].to_frame(arrival)
            if frame is not None:
                return frame
        reasons = [
            feed.explain_silence(self._arrivals.is_held(name)) for name, feed in self._feeds.items()
        ]
        raise NotReadyError(
            f"No image came within {timeout_s:g} s. {' '.join(reasons)}",
            hint="Start the camera's driver, or correct the topic.",
        )

    def close(self) -> None:
        """Stop reading; a `read` in progress ends with StateError. May be called twice."""
        self._arrivals.close()

    def _delivery(self, name: str) -> Callable[[Arrival], None]:
        return lambda arrival: self._arrivals.put(name, arrival)
