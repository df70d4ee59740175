"""The plugin for changes of presets: a policy of eight rows whose preset determines its runtime's
time.

Cameras, robot and controllers are those of `switch_plugin`. An action's `rz` contains the executed
share of the model, in milli-nano-radians (1e-12).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from switch_plugin import (  # noqa: F401 (hooks)
    NANO,
    roboneuron_controllers,
    roboneuron_perceptions,
    roboneuron_robots,
)

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import AccelerationSpec, ActionSpace, BackendSpec, RuntimeSpec

if TYPE_CHECKING:
    from roboneuron.contract import ActionChunk, Observation

PLUGIN = "preset_plugin"
FAMILY = "preset-test"
ROWS, STEP_S, WHOLE_S = 8, 0.05, 0.1
MODEL_BYTES = 64_000_000
SHARES = {"half": 0.5, "quarter": 0.25}


class PresetRuntime:
    """Implements the protocol `Runtime`, with `set_acceleration`; its model is 64 MB of memory."""

    def __init__(self, config: None) -> None:
        self.share = 1.0
        self.loads = 0
        self._model = b""

    def load(self, model: object, acceleration: Any = None) -> None:
        """Allocate the memory."""
        self._model = bytes(MODEL_BYTES)
        self.loads += 1
        self.set_acceleration(acceleration)

    def set_acceleration(self, acceleration: Any) -> None:
        """Execute another share."""
        if acceleration is None:
            self.share = 1.0
        else:
            acceleration.apply(self)

    def run(self, request: object) -> object:
        """Sleep for the time of the share."""
        time.sleep(WHOLE_S * self.share)
        return self.share

    def abort(self) -> None:
        """Nothing to abort: no run takes long."""

    def close(self) -> None:
        """Free the memory."""
        self._model = b""


class Half:
    """Executes half of the model."""

    share = SHARES["half"]

    def __init__(self, config: None) -> None:
        pass

    def apply(self, decoder: Any) -> None:
        """Set the runtime's share."""
        decoder.share = self.share


class Quarter(Half):
    """Executes a quarter of the model."""

    share = SHARES["quarter"]


class Unfit(Half):
    """Fits no model."""

    def apply(self, decoder: Any) -> None:
        """Refuse."""
        from roboneuron.errors import ConfigurationError

        raise ConfigurationError("This preset fits no model.")


class PresetBackend:
    """Implements the protocol `Backend`."""

    def __init__(self, config: None, runtime: Any = None, acceleration: Any = None) -> None:
        self._runtime, self._acceleration = runtime, acceleration

    def load(self) -> None:
        """Load the runtime's model."""
        self._runtime.load("model", self._acceleration)

    def predict(self, observation: Observation) -> ActionChunk:
        """Eight rows that move back and forth."""
        import numpy as np

        from roboneuron.contract import ActionChunk

        share = self._runtime.run("request")
        actions = np.zeros((ROWS, 7))
        actions[:, 0] = 0.001 * np.sign((observation.stamp_ns // 1_000_000_000) % 2 - 0.5)
        actions[:, 5] = share * 1e3 * NANO
        actions[:, 6] = 1.0
        return ActionChunk(
            actions=actions, step_s=STEP_S, metrics={"loads": self._runtime.loads, "share": share}
        )

    def reset(self) -> None:
        """Nothing to reset."""

    def close(self) -> None:
        """Release the runtime."""
        self._runtime.close()


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """One policy."""
    return [
        BackendSpec(
            name="preset-policy",
            summary="Moves to and fro.",
            target=f"{PLUGIN}:PresetBackend",
            action_space=ActionSpace(horizon=ROWS, step_s=STEP_S),
            family=FAMILY,
            runtimes_required=True,
            default_runtime="preset-runtime",
        )
    ]


@hookimpl
def roboneuron_runtimes() -> Sequence[RuntimeSpec]:
    """One runtime."""
    return [
        RuntimeSpec(
            name="preset-runtime",
            summary="Takes as long as its preset says.",
            target=f"{PLUGIN}:PresetRuntime",
            families=(FAMILY,),
            capabilities=("share",),
        )
    ]


@hookimpl
def roboneuron_accelerations() -> Sequence[AccelerationSpec]:
    """Two that work and one that does not."""
    return [
        AccelerationSpec(
            name=name,
            summary=f"Executes a part: {name}.",
            target=f"{PLUGIN}:{name.capitalize()}",
            families=(FAMILY,),
            capability="share",
        )
        for name in ("half", "quarter", "unfit")
    ]
