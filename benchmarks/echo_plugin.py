"""The plugin of bench_loop.py: a backend that answers at once, on a robot that exists only as a
profile.

The first four bytes of an image hold its number; the action returns it in its first value, so that
the benchmark knows which image an action answers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import ActionSpace, BackendSpec, CameraSpec, DriverSpec, RobotSpec

if TYPE_CHECKING:
    from roboneuron.contract import ActionChunk, Observation, RobotProfile

SHORTEST_STEP_S = 1e-3


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """One backend that copies the image's number into its action."""
    space = ActionSpace(step_s=SHORTEST_STEP_S)
    return [
        BackendSpec(
            name="echo", summary="answers at once", target="echo_plugin:Echo", action_space=space
        )
    ]


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """One robot with a camera."""
    driver = DriverSpec(name="simulated", summary="is never started", target="echo_plugin:Echo")
    camera = CameraSpec(name="front", role="primary")
    return [
        RobotSpec(
            name="bench",
            summary="a profile",
            target="echo_plugin:profile",
            drivers=(driver,),
            cameras=(camera,),
        )
    ]


def profile() -> RobotProfile:
    """A robot with only a camera."""
    from roboneuron.contract import CameraProfile, RobotProfile

    camera = CameraProfile(name="front", role="primary", frame_id="front", width=224, height=224)
    return RobotProfile(name="bench", cameras=(camera,))


class Echo:
    """Implements the protocol `Backend`."""

    def __init__(self, config: None, runtime: Any = None, acceleration: Any = None) -> None: ...

    def load(self) -> None:
        """Nothing to load."""

    def predict(self, observation: Observation) -> ActionChunk:
        """The image's number as a translation, which is never executed."""
        import numpy as np

        from roboneuron.contract import ActionChunk

        number = int.from_bytes(observation.frames["primary"].image[0].tobytes()[:4], "little")
        return ActionChunk(
            actions=np.array([[float(number), 0, 0, 0, 0, 0, 1.0]]), step_s=SHORTEST_STEP_S
        )

    def reset(self) -> None:
        """Nothing to reset."""

    def close(self) -> None:
        """Nothing to release."""
