"""Cameras of a simulated robot, as a perception source in a separate process that renders the
simulation's states from a topic.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Float64MultiArray

from rn_simulation.pinhole import PinholeCamera
from roboneuron import CameraProfile, ConfigurationError, Frame, NotReadyError, StateError, Topics

State = TypeVar("State", bound="StampedState")


class StampedState(Protocol):
    """State of a simulation at one time."""

    @property
    def stamp_ns(self) -> int:
        """ROS time of the state [ns]."""


class CameraOptions(Protocol):
    """Options of the user."""

    @property
    def rate_hz(self) -> float:
        """Images per second of each camera."""

    @property
    def width(self) -> int:
        """Width of an image [px]."""

    @property
    def height(self) -> int:
        """Height of an image [px]."""


class StateCameras(ABC, Generic[State]):
    """Renders the newest simulated state, one camera after the other; follows the protocol
    `PerceptionSource`.

    A frame has the stamp of its state, so that its age is correct. Each state is rendered at most
    once per camera: if the simulation stops, so do the frames. The source may start before or after
    the simulation, and follows it to another scene.

    Attributes:
        robot, topic: name of the robot, and topic of its simulation's state.
    """

    robot: str
    topic: str

    def __init__(
        self, options: CameraOptions, topics: Topics, cameras: Sequence[CameraProfile]
    ) -> None:
        """Store the arguments; `cameras` are profiles of the robot's cameras."""
        self._options = options
        self._topics = topics
        self._wanted = tuple(cameras)
        self._served: list[PinholeCamera] = []
        self._drawing = threading.Lock()
        self._arrived = threading.Condition()
        self._open = False
        self._subscribed = False
        self._message: Float64MultiArray | None = None
        self._received = 0
        self._shown_by_camera: dict[str, int] = {}
        self._turn = 0
        self._due_s = 0.0

    @abstractmethod
    def known(self) -> Sequence[PinholeCamera]:
        """The cameras of the simulation."""

    @abstractmethod
    def parse(self, message: Float64MultiArray) -> State:
        """Parse a message of `topic`. Raises InvalidInputError for an invalid one."""

    @abstractmethod
    def draw(
        self, state: State, camera: PinholeCamera, size: tuple[int, int]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32] | None]:
        """Render a camera's image of a state, uint8 (height, width, 3) RGB, of `size` (width,
        height) [px], and its depth as `Frame` has it; from one thread at a time.
        """

    @abstractmethod
    def release(self) -> None:
        """Release resources of rendering; `draw` may follow."""

    def open(self) -> None:
        """Subscribe to the simulation's state.

        Raises:
            ConfigurationError: no camera, or one that the simulation does not have.
            StateError: it is already open.
        """
        if self._open:
            raise StateError("The simulated cameras are open already.")
        known = {camera.name: camera for camera in self.known()}
        unknown = [camera.name for camera in self._wanted if camera.name not in known]
        if unknown or not self._wanted:
            what = f"no camera {unknown[0]!r}" if unknown else "nothing to show"
            raise ConfigurationError(
                f"The simulated {self.robot} has {what}, expected some of {', '.join(known)}."
            )
        self._served = [known[camera.name] for camera in self._wanted]
        self._shown_by_camera = {}
        self._message = None
        self._open = True
        if not self._subscribed:
            self._subscribed = True
            self._topics.subscribe(self.topic, Float64MultiArray, self._take)

    def read(self, timeout_s: float) -> Frame:
        """Return the next frame, with the cameras in rotation.

        Frames come at `rate_hz` per camera, evenly spread; if rendering is slower, all cameras slow
        down equally.

        Raises:
            NotReadyError: no newer state arrived on `topic`, or no frame was due, within
                `timeout_s`.
            StateError: not open.
            InvalidInputError: a message on `topic` that is not a simulation's state.
        """
        deadline_s = time.monotonic() + timeout_s
        self._await_turn(deadline_s, timeout_s)
        camera = self._served[self._turn % len(self._served)]
        state = self._await_state(camera, deadline_s, timeout_s)
        began_s = time.monotonic()
        width, height = self._options.width, self._options.height
        calibration = camera.calibration(width, height)
        with self._drawing:
            if not self._open:
                raise StateError("The simulated cameras were closed.")
            image, depth_m = self.draw(state, camera, (width, height))
        self._turn += 1
        self._schedule_next(began_s)
        return Frame(
            camera=camera.name,
            image=image,
            stamp_ns=state.stamp_ns,
            frame_id=camera.frame_id,
            calibration=calibration if calibration.mount in ("base", "tcp") else None,
            depth_m=depth_m,
        )

    def close(self) -> None:
        """Unsubscribe and release resources of rendering; a `read` in progress ends with
        StateError. May be called twice.
        """
        with self._arrived:
            self._open = False
            self._arrived.notify_all()
        with self._drawing:
            self.release()

    def _take(self, message: Float64MultiArray) -> None:
        with self._arrived:
            self._message = message
            self._received += 1
            self._arrived.notify_all()

    def _schedule_next(self, began_s: float) -> None:
        """Keep the schedule if the last frame was late by less than a slot, otherwise start a new
        one.
        """
        slot_s = 1.0 / (self._options.rate_hz * len(self._served))
        if began_s - self._due_s > slot_s:
            self._due_s = began_s
        self._due_s += slot_s

    def _await_turn(self, deadline_s: float, timeout_s: float) -> None:
        with self._arrived:
            while self._open and time.monotonic() < min(self._due_s, deadline_s):
                self._arrived.wait(min(self._due_s, deadline_s) - time.monotonic())
            if not self._open:
                raise StateError("The simulated cameras are not open.")
        if time.monotonic() < self._due_s:
            raise NotReadyError(
                f"No simulated image was due within {timeout_s:g} s.",
                hint=f"At rate_hz = {self._options.rate_hz:g} wait longer, or raise the rate.",
            )

    def _await_state(self, camera: PinholeCamera, deadline_s: float, timeout_s: float) -> State:
        def is_newer() -> bool:
            return self._message is not None and self._received > self._shown_by_camera.get(
                camera.name, 0
            )

        with self._arrived:
            self._arrived.wait_for(
                lambda: not self._open or is_newer(), max(0.0, deadline_s - time.monotonic())
            )
            if not self._open:
                raise StateError("The simulated cameras are not open.")
            if not is_newer() or self._message is None:
                raise NotReadyError(
                    f"No new state of the simulation arrived on topic {self.topic!r} within "
                    f"{timeout_s:g} s.",
                    hint=f"Start the robot {self.robot} with its simulated driver.",
                )
            message, received = self._message, self._received
            self._shown_by_camera[camera.name] = received
        return self.parse(message)
