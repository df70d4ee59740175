"""A plugin for these tests: the public fakes, and a camera that ticks."""

from __future__ import annotations

import time

from rn_testing.fakes import FAKE_SPECS, gradient_image
from roboneuron import Frame, PerceptionSpec, hookimpl


class TickingSource:
    """Serves its cameras in turn, about 20 frames per second each."""

    def __init__(self, config, topics, cameras) -> None:
        self._topics, self._cameras, self._index = topics, list(cameras), 0

    def open(self) -> None:
        """Nothing to open."""

    def read(self, timeout_s: float) -> Frame:
        time.sleep(0.05 / len(self._cameras))
        self._index += 1
        camera = self._cameras[self._index % len(self._cameras)]
        image = gradient_image(camera.width, camera.height)
        return Frame(camera=camera.name, image=image, stamp_ns=self._topics.now_ns(), frame_id=camera.frame_id)

    def close(self) -> None:
        """Nothing to close."""


def of_kind(kind: str):
    return tuple(spec for spec in FAKE_SPECS if spec.kind == kind)


@hookimpl
def roboneuron_robots():
    return of_kind("robot")


@hookimpl
def roboneuron_controllers():
    return of_kind("controller")


@hookimpl
def roboneuron_backends():
    return of_kind("backend")


@hookimpl
def roboneuron_perceptions():
    return (PerceptionSpec(name="ticking", summary="20 frames per second.", target=f"{__name__}:TickingSource"),)
