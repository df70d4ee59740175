"""The acceleration of an inference module: a ROS parameter, so that it changes without reading the model again."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from typing import Any, cast

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from roboneuron.contract import AccelerationChanger, AnyAcceleration
from roboneuron.errors import RoboNeuronError
from roboneuron.modules.module import ModuleNode
from roboneuron.modules.settings import ACCELERATION_PARAMETER

log = logging.getLogger(__name__)


class AccelerationInForce:
    """The preset that is in force, and the one that was asked for.

    The status tells `acceleration`, whether it can be changed (`acceleration_in_place`), and after each request
    `acceleration_answers`, `acceleration_refused` (the reason, empty when done) and `acceleration_changed_ns`.
    """

    def __init__(
        self,
        node: ModuleNode,
        name: str,
        parts: Iterable[object],
        make: Callable[[str], object],
    ) -> None:
        """Args:
        node: gets the parameter; a name, or empty for none.
        name: the one that the model was loaded with.
        parts: the backend and what it executes with; the first that can changes it.
        make: builds the one of that name; called on the predicting thread.
        """
        self._status = node.status
        self._make = make
        self._changer: AccelerationChanger[Any] | None = next(
            (part for part in parts if isinstance(part, AccelerationChanger)), None
        )
        self._name = name
        self._request = (0, name)
        self._answered = 0
        self._status.set_value("acceleration", name)
        self._status.set_value("acceleration_in_place", self._changer is not None)
        node.declare_parameter(ACCELERATION_PARAMETER, name)
        node.resources.callback(node.undeclare_parameter, ACCELERATION_PARAMETER)
        node.add_on_set_parameters_callback(self._check)
        node.resources.callback(node.remove_on_set_parameters_callback, self._check)
        node.add_post_set_parameters_callback(self._take)
        node.resources.callback(node.remove_post_set_parameters_callback, self._take)

    def change_if_asked(self) -> None:
        """Put what was asked for into force; between two predictions, on the thread that predicts."""
        count, name = self._request
        if count == self._answered or self._changer is None:
            return
        refused = ""
        try:
            if name != self._name:
                self._changer.set_acceleration(cast("AnyAcceleration", self._make(name)) if name else None)
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

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        asked = [parameter for parameter in parameters if parameter.name == ACCELERATION_PARAMETER]
        reason = ""
        if any(parameter.type_ is not Parameter.Type.STRING for parameter in asked):
            reason = "acceleration must be a string"
        elif asked and self._changer is None:
            reason = "the acceleration cannot be changed while the model is loaded"
        return SetParametersResult(successful=not reason, reason=reason)

    def _take(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == ACCELERATION_PARAMETER:
                self._request = (self._request[0] + 1, str(parameter.value))
