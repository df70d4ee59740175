"""Perception module: publishes a PerceptionSource's frames on `camera/<name>/image`,
calibrations on `.../camera_info`, and depth, if it measures it, on `.../depth`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import cast

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image

from roboneuron.contract import CameraProfile, Frame, PerceptionSource
from roboneuron.contract.arrays import F64
from roboneuron.errors import ConfigurationError, NotReadyError, PluginError
from roboneuron.modules.module_host import Module, ModuleHost
from roboneuron.modules.plugin import build, load_profile
from roboneuron.modules.worker import Worker
from roboneuron.plugins.specs import PerceptionSpec
from roboneuron.ros import messages, topics
from roboneuron.ros.host import NodeTopics

_READ_TIMEOUT_S = 0.25
"""Timeout of a read, below the 0.4 s after which the reading thread counts as stalled."""
SILENCE_S = 3.0
"""Time without any frame after which the source counts as failed."""


class PerceptionModule(Module):
    """Publishes the frames of one source, for all its cameras.

    One thread reads and publishes; transitions run on the executor's thread.
    """

    def __init__(self, node: ModuleHost) -> None:
        """Open the source for the configured cameras.

        Raises:
            ConfigurationError: there is no [perception] section, or the robot has no such camera.
            RoboNeuronError: the source cannot be opened.
        """
        super().__init__(node)
        config = self.config.perception
        if config is None:
            raise ConfigurationError("The configuration has no [perception] section.")
        profile = load_profile(self.registry, self.config.robot)
        cameras = _choose(profile.cameras, config.cameras, profile.name)
        spec = self.registry.get(PerceptionSpec, config.source)
        self._topics = NodeTopics(node)
        node.resources.callback(self._topics.close)
        options = self.config.options(spec.name)
        self._source = cast("PerceptionSource", build(spec, options, self._topics, cameras))
        node.resources.callback(self._source.close)
        self._source.open()
        self._images = {
            camera.name: node.advertise(Image, topics.camera_image(camera.name))
            for camera in cameras
        }
        self._infos = {
            camera.name: node.advertise(CameraInfo, topics.camera_info(camera.name))
            for camera in cameras
        }
        self._depths: dict[str, Callable[[Image], None]] = {}
        self._newest_s = 0.0
        self._missing: set[str] = set()
        self._worker = Worker("perception", self._step, self.status)
        node.resources.callback(self._worker.stop)
        self.status.set_value("source", spec.name)

    def activate(self) -> None:
        """Start reading; ready once every camera has delivered a frame."""
        self._newest_s = time.monotonic()
        self._missing = set(self._images)
        self._announce_missing()
        self._worker.start()

    def deactivate(self) -> None:
        """Stop reading.

        Raises:
            NotReadyError: the source hangs; later frames are not published.
        """
        if not self._worker.stop():
            raise NotReadyError(f"Source {self.config.perception} hangs in read().")

    def _announce_missing(self) -> None:
        names = ", ".join(repr(name) for name in sorted(self._missing))
        self.status.set_waiting(f"the first image of camera {names}")

    def _step(self, stop: threading.Event) -> None:
        """Read one frame and publish it. A late source is counted, but reported only after
        `SILENCE_S`, because cameras drop frames occasionally.
        """
        try:
            frame = self._source.read(_READ_TIMEOUT_S)
        except NotReadyError as error:
            self.status.drop("no_frame")
            if time.monotonic() - self._newest_s > SILENCE_S:
                self.status.set_error(error)
            return
        publisher = self._images.get(frame.camera)
        if publisher is None:
            raise PluginError(
                f"The source delivered camera {frame.camera!r}, asked for {sorted(self._images)}."
            )
        # deactivated while `read` was waiting
        if stop.is_set():
            return
        # of any camera: one that is late while others deliver is visible by its own `age_ms`
        self._newest_s = time.monotonic()
        self.status.set_value(
            f"size.{frame.camera}", f"{frame.image.shape[1]}x{frame.image.shape[0]}"
        )
        if self.filters.is_ours(frame.stamp_ns):
            # before the image: the receiver of an image needs its intrinsics
            image = messages.to_image(frame)
            if frame.calibration is not None:
                info = to_camera_info(frame.calibration.intrinsics, image)
                self._infos[frame.camera].publish(info)
            if frame.depth_m is not None:
                self._publish_depth(frame, frame.depth_m)
            publisher.publish(image)
            self.status.output.tick()
            self.filters.note_sent(frame.camera)
        age_ms = (self._topics.now_ns() - frame.stamp_ns) / 1e6
        self.status.latency.append(age_ms)
        self.status.set_value(f"age_ms.{frame.camera}", age_ms)
        self.status.clear_error()
        if self._missing:
            self._missing.discard(frame.camera)
            if self._missing:
                self._announce_missing()
            else:
                self.status.set_ready()

    def _publish_depth(self, frame: Frame, depth_m: NDArray[np.float32]) -> None:
        """Publish the depth of a frame; only cameras that measure it have this topic."""
        publish = self._depths.get(frame.camera)
        if publish is None:
            publish = self._topics.advertise(topics.camera_depth(frame.camera), Image)
            self._depths[frame.camera] = publish
        publish(messages.to_depth_image(frame, depth_m))


def _choose(
    cameras: tuple[CameraProfile, ...], names: tuple[str, ...], robot: str
) -> tuple[CameraProfile, ...]:
    """Return the profiles of `names`, or all of them if it is empty.

    Args:
        cameras: cameras of the robot.
        names: as configured.
        robot: its name, for messages.

    Raises:
        ConfigurationError: the robot has no such camera, or none at all; names its cameras.
    """
    by_name = {camera.name: camera for camera in cameras}
    unknown = [name for name in names if name not in by_name]
    if unknown or not by_name:
        raise ConfigurationError(
            f"Robot {robot!r} has no camera {', '.join(map(repr, unknown)) or 'at all'};"
            f" its cameras are {', '.join(map(repr, sorted(by_name))) or 'none'}."
        )
    return tuple(by_name[name] for name in names) if names else cameras


def to_camera_info(intrinsics: F64, image: Image) -> CameraInfo:
    """Create the message that accompanies an image of a camera without distortion.

    Source of the half pixel: image_geometry and OpenCV put pixel centres at integers, the contract
    at integers + 0.5.

    Args:
        intrinsics: float64 (3, 3) [px] in the contract's convention (see `CameraCalibration`).
        image: has the stamp, the frame and the size.
    """
    message = CameraInfo(header=image.header, height=image.height, width=image.width)
    centred = intrinsics.copy()
    centred[:2, 2] -= 0.5
    message.distortion_model = "plumb_bob"
    message.d = [0.0] * 5
    message.k = centred.ravel().tolist()
    message.r = np.eye(3).ravel().tolist()
    message.p = np.hstack([centred, np.zeros((3, 1))]).ravel().tolist()
    return message
