"""Test of the image transport from a second process, with its latency."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass

from roboneuron import NotReadyError

IMAGES = 20
_SIZE_PX = (640, 480)
_PERIOD_S = 0.05
_DISCOVERY_S = 10.0
_TIMEOUT_S = 20.0


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageTransport:
    """Result of the test.

    Attributes:
        sent, received: number of images.
        median_ms, worst_ms: age at arrival; 0 if none arrived.
        neighbours: full names of all nodes in the domain, including this process's.
    """

    sent: int
    received: int
    median_ms: float
    worst_ms: float
    neighbours: tuple[str, ...]


def measure_image_transport() -> ImageTransport:
    """Receive images from another process; takes about 3 s.

    Raises:
        NotReadyError: the other process failed.
    """
    # importing this module must not require the message package
    from rclpy.time import Time
    from sensor_msgs.msg import Image

    from roboneuron.command import RosLink

    topic = f"/roboneuron_doctor/images_{os.getpid()}"
    ages_ms: list[float] = []
    link = RosLink(f"roboneuron_doctor_{os.getpid()}")
    link.open()

    def receive(image: Image) -> None:
        stamp_ns = Time.from_msg(image.header.stamp).nanoseconds
        ages_ms.append((time.time_ns() - stamp_ns) / 1e6)

    try:
        link.subscribe(Image, topic, receive)
        try:
            sender = subprocess.run(
                [sys.executable, "-P", "-m", "rn_standard.doctor.images", topic],
                capture_output=True,
                text=True,
                timeout=_TIMEOUT_S,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise NotReadyError(
                f"The process that sends images took longer than {_TIMEOUT_S:g} s.",
                hint=f"The load of this machine is {os.getloadavg()[0]:.0f} on {os.cpu_count()} "
                "processors: run `roboneuron doctor` again when less runs beside it.",
            ) from error
        if sender.returncode != 0:
            words = sender.stderr.strip().splitlines()
            raise NotReadyError(
                f"The process that sends images failed: {words[-1] if words else 'no output'}"
            )
        node = link.node
        names = [
            f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces()
        ]
    finally:
        link.close()
    received = list(ages_ms)
    return ImageTransport(
        sent=int(sender.stdout.split()[-1]),  # Fast DDS prints to stdout too
        received=len(received),
        median_ms=statistics.median(received) if received else 0.0,
        worst_ms=max(received, default=0.0),
        neighbours=tuple(dict.fromkeys(names)),
    )


def send_images(topic: str) -> int:
    """Publish images after a subscription to `topic` appeared; return the number sent (all of them,
    with or without a subscriber).
    """
    import numpy as np

    from roboneuron import Frame
    from roboneuron.command import environment

    environment.prepare_environment()
    from sensor_msgs.msg import Image

    from roboneuron.command import RosLink, messages

    link = RosLink(f"roboneuron_doctor_sender_{os.getpid()}")
    link.open()
    try:
        publish = link.advertise(Image, topic)
        end_s = time.monotonic() + _DISCOVERY_S
        while link.node.count_subscribers(topic) == 0 and time.monotonic() < end_s:
            time.sleep(_PERIOD_S)
        time.sleep(0.2)  # the subscription's side matches slightly later than the publisher's
        width, height = _SIZE_PX
        pixels = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
        for _ in range(IMAGES):
            publish(
                messages.to_image(
                    Frame(camera="doctor", image=pixels, stamp_ns=time.time_ns(), frame_id="doctor")
                )
            )
            time.sleep(_PERIOD_S)
        return IMAGES
    finally:
        link.close()


if __name__ == "__main__":
    print(send_images(sys.argv[1]))
