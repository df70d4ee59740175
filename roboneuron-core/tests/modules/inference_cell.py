"""Inference alone, with a camera of the test."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray

from rn_testing.waiting import holds_within
from roboneuron.contract import Frame
from roboneuron.ros.messages import to_image


class Cell:
    """Inference, and a camera that delivers on request."""

    def __init__(
        self,
        world: Any,
        status_of: Any,
        backend: str,
        **options: Any,
    ) -> None:
        self.world, self._status_of = world, status_of
        self.actions = world.listen(Float64MultiArray, "action")
        replace = {'backend = "instant"': f'backend = "{backend}"'} | options.pop("replace", {})
        self.inference = world.start("inference", replace=replace, **options)
        self.images = world.publisher(Image, "camera/front/image")
        assert holds_within(lambda: world.node.count_publishers("/pair/action") == 1)

    def send_image(self, *, age_s: float = 0.0, **changes: Any) -> int:
        stamp_ns = self.world.node.get_clock().now().nanoseconds - int(age_s * 1e9)
        image = np.zeros((6, 8, 3), dtype=np.uint8)
        message = to_image(
            Frame(camera="front", image=image, stamp_ns=stamp_ns, frame_id="optical")
        )
        for name, value in changes.items():
            setattr(message, name, value)
        self.images.publish(message)
        return int(stamp_ns)

    def send_until(self, is_done: Callable[[], bool], **image: Any) -> bool:
        """Send an image, or one of a few: on a busy machine one may be late."""
        for _ in range(10):
            self.send_image(**image)
            if holds_within(is_done, 2.0):
                return True
        return False

    def status(self) -> dict[str, str]:
        return dict(self._status_of(self.inference))

    def set(self, **moments_ns: int) -> None:
        parameters = [Parameter(name, value=value) for name, value in moments_ns.items()]
        results = self.world.run(lambda: self.inference.set_parameters(parameters))
        assert all(result.successful for result in results)

    def instruct(self, text: Any) -> Any:
        return self.world.run(
            lambda: self.inference.set_parameters([Parameter("instruction", value=text)])
        )[0]
