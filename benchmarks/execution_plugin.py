"""The plugin of bench_execution.py: a policy that answers late, on a robot that exists only as a
profile.

The first 24 bytes of an image hold the position of the TCP, so that the policy closes the loop
without a robot process.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, Field

from roboneuron import hookimpl
from roboneuron.plugins.specs import ActionSpace, BackendSpec, CameraSpec, DriverSpec, RobotSpec

if TYPE_CHECKING:
    from roboneuron.contract import ActionChunk, Observation, RobotProfile

SIDE_PX = 64
STEP_S = 0.05


class LateOptions(BaseModel):
    """Latency and rows of the answers."""

    rows: int = Field(default=8, ge=1, le=64, description="rows of a chunk")
    latency_ms: float = Field(
        default=112.0, ge=0, description="median time of a prediction [ms]; lognormal"
    )
    jitter: float = Field(default=0.2, ge=0, description="standard deviation of its logarithm")
    conditions_on_rows: bool = Field(default=False, description="continues the committed rows")


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """The same policy twice: ignoring the rows ahead, and continuing them."""
    space = ActionSpace(horizon=64, step_s=STEP_S)
    return [
        BackendSpec(
            name=name,
            summary="answers late",
            target="execution_plugin:Late",
            config="execution_plugin:LateOptions",
            action_space=space,
            conditions_on_rows=name == "late-rtc",
        )
        for name in ("late", "late-rtc")
    ]


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """One robot with a camera."""
    driver = DriverSpec(
        name="simulated", summary="is never started", target="execution_plugin:Late"
    )
    camera = CameraSpec(name="front", role="primary")
    target = "execution_plugin:profile"
    return [
        RobotSpec(
            name="bench", summary="a profile", target=target, drivers=(driver,), cameras=(camera,)
        )
    ]


def profile() -> RobotProfile:
    """A robot with only a camera."""
    from roboneuron.contract import CameraProfile, RobotProfile

    camera = CameraProfile(
        name="front", role="primary", frame_id="front", width=SIDE_PX, height=SIDE_PX
    )
    return RobotProfile(name="bench", cameras=(camera,))


class Late:
    """Implements the protocol `Backend`: the policy of the virtual cell, which sleeps for its
    latency.
    """

    def __init__(
        self, config: LateOptions | None, runtime: Any = None, acceleration: Any = None
    ) -> None:
        import numpy as np

        from rn_standard.execution.virtual_cell import VirtualPolicy

        self._options = config or LateOptions()
        self._random = np.random.default_rng(0)
        self._policy = VirtualPolicy(
            self._options.rows, STEP_S, self._options.conditions_on_rows, self._random
        )

    def load(self) -> None:
        """Nothing to load."""

    def predict(self, observation: Observation) -> ActionChunk:
        """The chunk, after its latency."""
        import numpy as np

        options = self._options
        end_s = time.monotonic() + options.latency_ms / 1e3 * math.exp(
            options.jitter * self._random.standard_normal()
        )
        frame = observation.frames["primary"]
        tcp_m = np.frombuffer(frame.image.tobytes()[:24], dtype=np.float64)
        chunk = self._policy.predict(frame.stamp_ns / 1e9, tcp_m, observation.ahead)
        time.sleep(max(0.0, end_s - time.monotonic()))
        return chunk

    def reset(self) -> None:
        """Nothing to reset."""

    def close(self) -> None:
        """Nothing to release."""
