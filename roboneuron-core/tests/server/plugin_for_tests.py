"""A plugin for tests of the server: the public fakes, a camera with a fixed rate, and parts that
refuse.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence

from roboneuron import Feature
from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import BackendSpec, FeatureSpec, PerceptionSpec

print("a plugin that prints while it is imported")
os.write(1, b"and one that writes to the descriptor\n")


class TickingSource:
    """Serves its cameras in rotation, with 20 frames per second each."""

    def __init__(self, config, topics, cameras) -> None:
        self.topics, self.cameras, self.index = topics, list(cameras), 0

    def open(self) -> None:
        self.open_s = time.monotonic()

    def read(self, timeout_s):
        from rn_testing.fakes import gradient_image
        from roboneuron.contract import Frame

        time.sleep(0.05 / len(self.cameras))
        self.index += 1
        camera = self.cameras[self.index % len(self.cameras)]
        image = gradient_image(camera.width, camera.height)
        return Frame(
            camera=camera.name, image=image, stamp_ns=self.topics.now_ns(), frame_id=camera.frame_id
        )

    def close(self) -> None:
        pass


class SilentSource(TickingSource):
    """Opens, but never delivers."""

    def read(self, timeout_s):
        from roboneuron.errors import NotReadyError

        threading.Event().wait(timeout_s)
        raise NotReadyError(f"No frame came within {timeout_s:g} s.")


def picky(config, runtime=None, acceleration=None):
    """A backend that cannot act on unicorns."""
    from rn_testing.fakes import InstantBackend
    from roboneuron.errors import UngroundedError

    class Picky(InstantBackend):
        def predict(self, observation):
            if "unicorn" in observation.instruction:
                raise UngroundedError(
                    "There is no unicorn in the image.", hint="Name what is visible."
                )
            return super().predict(observation)

    return Picky(None)


class LingeringFeature(Feature):
    """Never finishes closing, if configured so."""

    def close(self) -> None:
        if os.environ.get("TEST_FEATURE_LINGERS"):
            threading.Event().wait()


@hookimpl
def roboneuron_features() -> Sequence[FeatureSpec]:
    """Offer a feature without tools."""
    target = "rn_server_tests_plugin:LingeringFeature"
    return [FeatureSpec(name="lingering", summary="Closes, or does not.", target=target)]


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """Offer the fakes."""
    from rn_testing.fakes.backend import FAKE_BACKEND

    here = "rn_server_tests_plugin"
    return [
        FAKE_BACKEND,
        BackendSpec(
            name="picky", summary="Refuses unicorns.", target=f"{here}:picky", needs_state=True
        ),
        BackendSpec(
            name="heavy", summary="Needs weights.", target=f"{here}:picky", needs_checkpoint=True
        ),
        BackendSpec(
            name="blind",
            summary="Needs a thermal camera.",
            target=f"{here}:picky",
            cameras=("thermal",),
        ),
    ]


@hookimpl
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:
    """Offer a source that works and one that does not."""
    here = "rn_server_tests_plugin"
    return [
        PerceptionSpec(name="ticking", summary="Gradients, 20 Hz.", target=f"{here}:TickingSource"),
        PerceptionSpec(name="silent", summary="Never delivers.", target=f"{here}:SilentSource"),
    ]


@hookimpl
def roboneuron_controllers():
    """Offer the fake controller."""
    from rn_testing.fakes.controller import FAKE_CONTROLLER

    return [FAKE_CONTROLLER]


@hookimpl
def roboneuron_robots():
    """Offer the fake robot."""
    from rn_testing.fakes.robot import FAKE_ROBOT

    return [FAKE_ROBOT]
