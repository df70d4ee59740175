"""A plugin for tests with real processes: the public fakes, and a camera with a fixed rate.

A PluginSite installs it by its name: `install("rn-tests", "", value="rn_testing.fakes.ticking")`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from rn_testing.fakes import FAKE_SPECS, gradient_image
from roboneuron import CameraProfile, Frame, PerceptionSpec, Spec, Topics, hookimpl


class TickingSource:
    """Serves its cameras in rotation, with about 20 frames per second each."""

    def __init__(self, config: None, topics: Topics, cameras: Sequence[CameraProfile]) -> None:
        self._topics, self._cameras, self._index = topics, list(cameras), 0

    def open(self) -> None:
        """Do nothing."""

    def read(self, timeout_s: float) -> Frame:
        time.sleep(0.05 / len(self._cameras))
        self._index += 1
        camera = self._cameras[self._index % len(self._cameras)]
        image = gradient_image(camera.width, camera.height)
        return Frame(
            camera=camera.name,
            image=image,
            stamp_ns=self._topics.now_ns(),
            frame_id=camera.frame_id,
        )

    def close(self) -> None:
        """Do nothing."""


def _of_kind(kind: str) -> tuple[Spec, ...]:
    return tuple(spec for spec in FAKE_SPECS if spec.kind == kind)


@hookimpl
def roboneuron_robots() -> tuple[Spec, ...]:
    """The fakes' robots."""
    return _of_kind("robot")


@hookimpl
def roboneuron_controllers() -> tuple[Spec, ...]:
    """The fakes' controllers."""
    return _of_kind("controller")


@hookimpl
def roboneuron_backends() -> tuple[Spec, ...]:
    """The fakes' backends."""
    return _of_kind("backend")


@hookimpl
def roboneuron_perceptions() -> tuple[Spec, ...]:
    """The ticking camera."""
    return (
        PerceptionSpec(
            name="ticking", summary="20 frames per second.", target=f"{__name__}:TickingSource"
        ),
    )
