"""Topics of one camera: arrival of messages, conversion to frames, and reasons for missing
frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from rn_perception_camera.camera_info import CameraFacts, read_optics
from rn_perception_camera.fit import F32, Size
from rn_perception_camera.nested import image_getter, load_type
from rn_perception_camera.options import RosCameraOptions
from rn_perception_camera.preparation import Preparation, measured_undistortion, prepare
from roboneuron import (
    CameraProfile,
    ConfigurationError,
    Frame,
    InvalidInputError,
    Topics,
    depth_from_message,
    frame_from_compressed,
    image_from_message,
)

if TYPE_CHECKING:
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image

U8 = NDArray[np.uint8]

RAW = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
CLOCK_LIMIT_S = 10.0
"""Largest plausible difference of a stamp from ROS time; beyond it the clock differs."""
_NS_PER_S = 1_000_000_000
_SAME_NS = 2_000_000
"""Stamps of an image and its depth differ by at most this."""
_KEPT = 3
"""Depths that wait for their image: the two come on different topics."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Arrival:
    """A message and its arrival time [ROS time, ns], and the depth of the same time if one came."""

    message: object
    arrived_ns: int
    depth: Image | None = None


def _ns_of(message: Image | CompressedImage) -> int:
    """Stamp [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


class CameraFeed:
    """Subscriptions to one camera's topics; messages are received on the host's thread and
    converted on the reading thread.

    Args:
        deliver: receives each convertible image.
    """

    def __init__(
        self,
        profile: CameraProfile,
        options: RosCameraOptions,
        topics: Topics,
        deliver: Callable[[Arrival], None],
    ) -> None:
        self._profile = profile
        self._options = options
        self._topics = topics
        self._deliver = deliver
        self._facts: CameraFacts | None = None
        self._waits_for_info = False
        self._went_back = False
        self._newest_ns = 0
        self._prepared: tuple[Size, CameraFacts | None] | None = None
        self._preparation: Preparation | None = None
        self._depths: deque[Image] = deque(maxlen=_KEPT)
        self._unpaired: Arrival | None = None
        self._image_type = RAW if options.transport == "raw" else COMPRESSED
        self._image_of: Callable[[object], object] = lambda message: message

    def check(self) -> None:
        """Raise ConfigurationError if a topic is published with another type, the type or its image
        field is unknown, or no mount is known.
        """
        options = self._options
        if options.type is not None and options.field is not None:
            self._image_of = image_getter(options.type, options.field, self._image_type)
        if (
            options.camera_info is not None
            and self._profile.calibration is None
            and options.distortion != "undistort"
        ):
            raise ConfigurationError(
                f"Camera {self._profile.name!r} is to be calibrated by {options.camera_info!r}, "
                "but the robot's profile"
                " does not tell where it is mounted.",
                hint=f"Measure it: `roboneuron robot cameras calibrate {self._profile.name}`. Or "
                "leave camera_info out.",
            )
        self._check_type(options.topic, options.type or self._image_type)
        if options.camera_info is not None:
            self._check_type(options.camera_info, INFO)
        if options.depth is not None:
            self._check_type(options.depth, RAW)

    def subscribe(self) -> None:
        """Subscribe until the host closes; called once, from `open`, after `check`."""
        from sensor_msgs.msg import CameraInfo, Image  # heavy

        options = self._options
        kind = load_type(options.type or self._image_type)
        if self._options.camera_info is not None:
            self._topics.subscribe(
                self._options.camera_info, CameraInfo, self._take_info, best_effort=True
            )
        if options.depth is not None:
            self._topics.subscribe(options.depth, Image, self._take_depth, best_effort=True)
        self._topics.subscribe(self._options.topic, kind, self._take, best_effort=True)

    def to_frame(self, arrival: Arrival) -> Frame | None:
        """Convert an image to a frame; None for one that was not captured after the previous frame.

        Raises:
            InvalidInputError: a damaged image, an unknown encoding, or a stamp that is unset or of
                another clock.
            ConfigurationError: its camera_info cannot be used for it.
        """
        message = cast("Image | CompressedImage", self._image_of(arrival.message))
        stamp_ns = self._stamp_ns(message, arrival.arrived_ns)
        if self._newest_ns > arrival.arrived_ns + CLOCK_LIMIT_S * _NS_PER_S:
            self._newest_ns = 0  # the clock was set back
        self._went_back = stamp_ns <= self._newest_ns
        if self._went_back:
            return None
        image = self._convert(message)
        preparation = self._prepare((image.shape[1], image.shape[0]))
        prepared = preparation.apply(image)
        self._newest_ns = stamp_ns
        driver_frame_id = str(message.header.frame_id) if self._options.frame_id == "driver" else ""
        return Frame(
            camera=self._profile.name,
            image=prepared,
            stamp_ns=stamp_ns,
            frame_id=driver_frame_id or self._profile.frame_id,
            calibration=preparation.calibration,
            depth_m=self._depth_of(arrival, preparation),
        )

    def explain_silence(self, held: bool) -> str:
        """Explain in one sentence why no frame comes; `held`: one waits for its turn.

        Raises:
            ConfigurationError: a topic is published with another type.
        """
        self.check()
        options, name = self._options, self._profile.name
        if held:
            return (
                f"The next image of camera {name!r} is not due yet (max_rate_hz = "
                f"{options.max_rate_hz})."
            )
        if not self._topics.publisher_types(options.topic):
            return f"Nobody publishes images of camera {name!r} on topic {options.topic!r}."
        if self._waits_for_info and options.camera_info is not None:
            absent = not self._topics.publisher_types(options.camera_info)
            why = "which nobody publishes" if absent else "on which nothing came"
            return (
                f"Images of camera {name!r} wait for their calibration on topic "
                f"{options.camera_info!r}, {why}."
            )
        if self._went_back:
            return (
                f"Images of camera {name!r} on topic {options.topic!r} are stamped no later "
                "than the one before."
            )
        return f"Topic {options.topic!r} of camera {name!r} has a publisher, but nothing new came."

    def _take(self, message: object) -> None:
        self._waits_for_info = self._options.camera_info is not None and self._facts is None
        if self._waits_for_info:
            return
        arrival = Arrival(message=message, arrived_ns=self._topics.now_ns())
        if self._options.depth is None:
            self._deliver(arrival)
            return
        if self._unpaired is not None:
            self._deliver(self._unpaired)  # its depth was lost; the image is still good
        self._unpaired = arrival
        self._pair()

    def _take_depth(self, message: Image) -> None:
        self._depths.append(message)
        self._pair()

    def _pair(self) -> None:
        """Deliver the image that waits for its depth if that has come."""
        arrival = self._unpaired
        if arrival is None:
            return
        stamp_ns = _ns_of(cast("Image | CompressedImage", self._image_of(arrival.message)))
        depth = next((one for one in self._depths if abs(_ns_of(one) - stamp_ns) <= _SAME_NS), None)
        if depth is not None:
            self._unpaired = None
            self._deliver(replace(arrival, depth=depth))

    def _take_info(self, message: CameraInfo) -> None:
        self._facts = CameraFacts.from_message(message)

    def _check_type(self, topic: str, expected: str) -> None:
        types = self._topics.publisher_types(topic)
        if not types or expected in types:
            return
        hint = f"Name a topic that carries {expected}."
        if self._options.type is None and expected != INFO:
            hint += " If its messages hold the image, set type and field."
        other = {RAW: "raw", COMPRESSED: "compressed"}.get(types[0])
        if other is not None and expected == self._image_type:
            hint = f'Set transport = "{other}".'
        raise ConfigurationError(
            f"Topic {topic!r} of camera {self._profile.name!r} carries {types[0]}, expected "
            f"{expected}.",
            hint=hint,
        )

    def _stamp_ns(self, message: Image | CompressedImage, arrived_ns: int) -> int:
        if self._options.stamp == "arrival":
            return arrived_ns
        stamp_ns = _ns_of(message)
        ahead_s = (stamp_ns - arrived_ns) / _NS_PER_S
        what = ""
        if stamp_ns <= 0:
            what = "carries no capture time in header.stamp"
        elif abs(ahead_s) > CLOCK_LIMIT_S:
            what = (
                f"is stamped {abs(ahead_s):.1f} s {'ahead of' if ahead_s > 0 else 'behind'} "
                "ROS time when it arrives"
            )
        if what:
            raise InvalidInputError(
                f"An image of camera {self._profile.name!r} on topic {self._options.topic!r} "
                f"{what}.",
                hint='Let the driver stamp with the time of capture, or set stamp = "arrival".',
            )
        return stamp_ns

    def _depth_of(self, arrival: Arrival, preparation: Preparation) -> F32 | None:
        """Raises InvalidInputError."""
        message = arrival.depth
        if message is None:
            return None
        where = f"The depth of camera {self._profile.name!r} on topic {self._options.depth!r}"
        try:
            depth_m = depth_from_message(message)
        except InvalidInputError as error:
            raise InvalidInputError(f"{where} cannot be used. {error.message}") from error
        size = (depth_m.shape[1], depth_m.shape[0])
        if size != preparation.fit.source:
            raise InvalidInputError(
                f"{where} has {size[0]}x{size[1]} pixels, its images have "
                f"{preparation.fit.source[0]}x{preparation.fit.source[1]}.",
                hint="Name the topic of the depth that is registered to these images.",
            )
        return preparation.fit.apply_depth(depth_m)

    def _convert(self, message: Image | CompressedImage) -> U8:
        try:
            if self._options.transport == "raw":
                return image_from_message(message)
            return frame_from_compressed(message.data, message.format)
        except InvalidInputError as error:
            raise InvalidInputError(
                f"An image of camera {self._profile.name!r} on topic {self._options.topic!r} "
                "cannot be used."
                f" {error.message}",
                hint=error.hint or self._other_way(),
            ) from error

    def _other_way(self) -> str:
        return (
            "Let the driver publish one of these, or use its compressed topic: "
            'transport = "compressed".'
            if self._options.transport == "raw"
            else 'Use the driver\'s raw topic: transport = "raw".'
        )

    def _prepare(self, size: Size) -> Preparation:
        facts = self._facts
        if self._preparation is not None and self._prepared == (size, facts):
            return self._preparation
        distortion = self._options.distortion
        if facts is None or not isinstance(distortion, str):
            coefficients = None if isinstance(distortion, str) else distortion
            undistortion = measured_undistortion(self._profile, size, coefficients)
            preparation = prepare(
                self._profile, size, self._options.resize, undistortion=undistortion
            )
        else:
            try:
                intrinsics, undistortion = read_optics(facts, size, distortion)
            except ConfigurationError as error:
                raise ConfigurationError(
                    f"The calibration of camera {self._profile.name!r} on topic "
                    f"{self._options.camera_info!r} cannot be"
                    f" used. {error.message}",
                    hint=error.hint,
                ) from error
            preparation = prepare(
                self._profile,
                size,
                self._options.resize,
                intrinsics=intrinsics,
                undistortion=undistortion,
            )
        self._preparation, self._prepared = preparation, (size, facts)
        return preparation
