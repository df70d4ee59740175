"""Acceleration of an inference module: a ROS parameter, so that it can change without reloading the
model.
"""

from __future__ import annotations

import logging
import time
from typing import Protocol, cast, runtime_checkable

from roboneuron.contract import AnyAcceleration
from roboneuron.errors import RoboNeuronError
from roboneuron.modules.inference.module import InferenceModule
from roboneuron.modules.module_host import ModuleHost
from roboneuron.modules.plugin import build
from roboneuron.modules.step_filters import StepFilter
from roboneuron.plugins.specs import AccelerationSpec
from roboneuron.switching.standby import ACCELERATION_PARAMETER

log = logging.getLogger(__name__)


@runtime_checkable
class AccelerationChanger(Protocol):
    """Optional interface of a runtime: another acceleration for the loaded model, without reloading
    it.

    A backend that executes its model itself may implement it too. Importing this protocol is not
    necessary.
    """

    def set_acceleration(self, acceleration: AnyAcceleration | None) -> None:
        """Execute every later `run` with this preset, or with none.

        Called on the thread that calls `run`, between two calls, while the robot moves. It takes
        milliseconds (on CUDA the time of a few predictions, once for each preset, if it records).
        The answers then equal those of a model that was loaded with the preset.

        Raises:
            RoboNeuronError: the preset is refused; the previous one stays in force.
            StateError: before `load` or after `close`.
        """
        ...


class AccelerationInForce(StepFilter):
    """The present and the requested preset.

    The status shows whether it can be changed (`acceleration_in_place`), and after each request
    `acceleration`, `acceleration_answers`, `acceleration_refused` (the reason, empty on success)
    and `acceleration_changed_ns`.
    """

    phase = StepFilter.StepPhase.POLICY

    def __init__(self, host: ModuleHost, module: InferenceModule) -> None:
        """Args:
        host: gets the parameter.
        module: its backend or its runtime, the first that supports it, changes the preset.
        """
        self._status = host.status
        self._module = module
        parts: tuple[object, ...] = (module.backend, module.runtime)
        self._changer: AccelerationChanger | None = next(
            (part for part in parts if isinstance(part, AccelerationChanger)), None
        )
        config = module.config.inference
        self._name = (config.acceleration if config is not None else None) or ""
        self._request = (0, self._name)
        self._answered = 0
        self._status.set_value("acceleration_in_place", self._changer is not None)
        host.resources.callback(
            host.add_parameter(ACCELERATION_PARAMETER, self._name, self._take, self._refusal)
        )

    def prepare(self) -> None:
        """Apply the requested preset; between two predictions, on the predicting thread."""
        count, name = self._request
        if count == self._answered or self._changer is None:
            return
        refused = ""
        try:
            if name != self._name:
                self._changer.set_acceleration(self._made(name) if name else None)
        except RoboNeuronError as error:
            refused = str(error)
        except Exception as error:  # the module border: plugins may raise anything
            log.exception("the acceleration could not be changed")
            refused = f"{type(error).__name__}: {error}"
        else:
            self._name = name
        self._answered = count
        self._status.set_value("acceleration", self._name)
        self._status.set_value("acceleration_refused", refused)
        self._status.set_value("acceleration_changed_ns", time.time_ns())
        self._status.set_value("acceleration_answers", count)
        self._status.changed.set()

    def _made(self, name: str) -> AnyAcceleration:
        spec = self._module.registry.get(AccelerationSpec, name)
        return cast("AnyAcceleration", build(spec, self._module.config.options(name)))

    def _refusal(self, _: str) -> str:
        return (
            ""
            if self._changer is not None
            else "the acceleration cannot be changed while the model is loaded"
        )

    def _take(self, name: str) -> None:
        self._request = (self._request[0] + 1, name)
