"""Recovery of a robot from a fault: a ROS parameter, so that only the server of this module may ask for it."""

from __future__ import annotations

import threading

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from roboneuron.contract import RecoverableDriver
from roboneuron.errors import RoboNeuronError
from roboneuron.modules.module import ModuleNode
from roboneuron.modules.settings import RECOVER_PARAMETER


class Recovery:
    """Asks the driver in a thread of its own, for it may take seconds, and reports "<number> <word> <text>"."""

    def __init__(self, node: ModuleNode, driver: RecoverableDriver) -> None:
        self._status = node.status
        self._driver = driver
        self._busy = threading.Lock()
        node.add_on_set_parameters_callback(self._check)
        node.resources.callback(node.remove_on_set_parameters_callback, self._check)
        node.add_post_set_parameters_callback(self._take)
        node.resources.callback(node.remove_post_set_parameters_callback, self._take)
        node.declare_parameter(RECOVER_PARAMETER, 0)
        node.resources.callback(node.undeclare_parameter, RECOVER_PARAMETER)

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name == RECOVER_PARAMETER and parameter.type_ is not Parameter.Type.INTEGER:
                return SetParametersResult(successful=False, reason="recover must be an integer")
        return SetParametersResult(successful=True)

    def _take(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == RECOVER_PARAMETER and parameter.value:
                threading.Thread(target=self._run, args=(parameter.value,), name="recovery", daemon=True).start()

    def _run(self, number: int) -> None:
        with self._busy:
            try:
                told = f"recovered {self._driver.recover()}"
            except RoboNeuronError as error:
                told = f"{error.code} {error}"
        self._status.set_value("recovery", f"{number} {told}")
        self._status.changed.set()
